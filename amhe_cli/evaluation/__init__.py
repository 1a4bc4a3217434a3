"""Many runs as one study: which cells there are, their result files, and what they say together."""

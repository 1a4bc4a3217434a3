"""Many runs as one study: cells, their result files, and what they say together."""

"""Which excitation makes the parameters visible: information, plans, playback."""

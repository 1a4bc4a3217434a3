"""Floor 4, results become things to read: tables, files, one page."""

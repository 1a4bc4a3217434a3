"""Results for readers: tables, files, one page."""

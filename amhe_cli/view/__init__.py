"""Systems and logs as people see them: scenes, ghosts, and the page that plays them in a browser."""

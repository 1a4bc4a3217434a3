"""SPI: search over clips of all logs, posterior, checks and verdicts."""

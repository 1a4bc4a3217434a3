"""Messages of a system that is running: transports bring them, and a source makes samples of them."""

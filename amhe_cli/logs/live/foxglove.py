"""Messages for Foxglove and Lichtblick, which look at them live (package `foxglove-sdk`)."""

from __future__ import annotations

import time
from typing import Any

from amhe_cli.core.errors import ConfigError
from amhe_cli.logs.messages.definitions import Definitions


class FoxgloveServer:
    """Serves messages at ws://127.0.0.1:PORT.

    Args:
        port: Port to listen on; 0: any that is free.
        definitions: Definitions of the messages' types.

    Raises:
        ConfigError: The package is missing, or the port is taken.
    """

    def __init__(self, port: int, definitions: Definitions) -> None:
        try:
            import foxglove  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ConfigError("`live.foxglove` needs foxglove-sdk: pip install 'amhe[foxglove]'") from None
        self._foxglove, self._definitions = foxglove, definitions
        self._context, self._channels = foxglove.Context(), dict[str, Any]()
        try:
            self._server = foxglove.start_server(
                name="amhe", host="127.0.0.1", port=port, context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"`live.foxglove`: port {port} cannot be served: {error}") from None

    @property
    def address(self) -> str:
        """Where Foxglove finds it."""
        return f"ws://127.0.0.1:{self._server.port}"

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """Show a message in CDR."""
        if topic not in self._channels:
            text = self._definitions.described(msgtype)[0].encode()
            schema = self._foxglove.Schema(name=msgtype, encoding="ros2msg", data=text)
            self._channels[topic] = self._foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
        self._channels[topic].log(message, log_time=time.time_ns())

    def close(self) -> None:
        """Let go of the port."""
        self._server.stop()

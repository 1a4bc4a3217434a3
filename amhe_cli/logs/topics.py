"""Messages of one topic with all their fields: for the few topics that amhe itself writes."""

from __future__ import annotations

from pathlib import Path

from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import Connection, readable
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.split import Splitter

#: Fields of a message by their paths, such as "parameters[0].value": numbers, names and marks.
Fields = dict[str, float | str]


def read_topic(path: Path, topic: str) -> list[tuple[int, Fields]]:
    """Log time [ns] and fields of each message of a topic, in their order; [] where there is no such topic.

    Raises:
        LogError: The log cannot be read.
    """
    found: list[tuple[int, Fields]] = []
    with readable(path):
        definitions, splitters = Definitions(), dict[Connection, Splitter]()
        for batch in open_log(path).batches({topic}):
            own = splitters.setdefault(batch.connection, Splitter(batch.connection, definitions))
            for group in own.split(batch):
                numbers = {
                    name if leaf.count is None else f"{name}[{i}]": one.read(group.rows).tolist()
                    for name, leaf in group.layout.leaves.items()
                    for i, one in enumerate(group.layout.columns(name))
                }
                for i, row in enumerate(group.members):
                    fields = {name: float(values[i]) for name, values in numbers.items()}
                    found.append((int(batch.log_ns[row]), {**group.layout.strings, **fields}))
    return sorted(found, key=lambda message: message[0])

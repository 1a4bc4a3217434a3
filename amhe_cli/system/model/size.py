"""A look at an MJCF before MuJoCo reads it: a few bytes of it can ask for any time and memory."""

from __future__ import annotations

import re
from math import prod
from pathlib import Path
from xml.etree import ElementTree

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_FOLDERS = ("meshdir", "texturedir", "assetdir")
#: Attributes that together say how many numbers an element holds.
_SIZES = (("nrow", "ncol"), ("width", "height"))


def check_model(path: Path) -> None:
    """Refuse a model whose elements multiply beyond the limits, or that names a pipe or a device.

    Raises:
        ConfigError: It is such a model; what is no XML is left to MuJoCo to refuse.
    """
    waiting, seen = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        check_regular(file)
        if file in seen or not file.is_file():
            continue
        seen.add(file)
        try:
            text = file.read_text(encoding="utf-8", errors="replace")
            root = ElementTree.fromstring(_COMMENT.sub("", text))
        except ElementTree.ParseError:
            continue
        _check_elements(root, file)
        waiting += [path.parent / one.get("file", "") for one in root.iter("include")]
        folders = {one.get(key, "") for one in root.iter("compiler") for key in _FOLDERS}
        for name in {name for one in root.iter() if (name := one.get("file"))}:
            for folder in ("", *folders):
                check_regular(path.parent / folder / name)


def _check_elements(root: ElementTree.Element, path: Path) -> None:
    waiting, elements = [(root, 1)], 0
    while waiting:
        one, times = waiting.pop()
        copies = prod(map(_number, one.get("count", "1").split()))
        elements += times * copies
        below = times * copies if one.tag == "replicate" else times
        numbers = max(prod(_number(one.get(name, "1")) for name in names) for names in _SIZES)
        if one.tag == "size":
            numbers = max(map(_number, one.attrib.values()), default=1)
        if elements > limits().model_elements:
            raise ConfigError(f"{path}: {beyond('model_elements', 'its elements are')}")
        if numbers > limits().model_numbers:
            raise ConfigError(f"{path}: <{one.tag}>: {beyond('model_numbers', f'{numbers} numbers are')}")
        waiting += [(child, below) for child in one]


def _number(text: str) -> int:
    """A number in an attribute; 1 for what is none, as MuJoCo refuses it."""
    try:
        return max(1, int(text))
    except ValueError:
        return 1

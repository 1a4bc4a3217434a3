"""A look at a model before MuJoCo reads it: a few bytes of it can ask for any time and memory."""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import prod
from pathlib import Path
from xml.etree import ElementTree

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits

#: A comment; MuJoCo allows two hyphens in it, which XML does not.
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
#: Attributes of the compiler that say where files lie.
_FOLDERS = ("meshdir", "texturedir", "assetdir")
#: Attributes that together say how many numbers an element holds.
_SIZES = (("nrow", "ncol"), ("width", "height"), ("dim",), ("nsample",))
#: Elements that cost more than others, and as many of which each counts: MuJoCo's time for them is quadratic.
_WEIGHTS = {"body": 4, "default": 4}
#: How deep models may be attached to models.
_DEEPEST = 5
#: First bytes of a PNG; its width and height follow the length and the name of the first chunk.
_PNG = b"\x89PNG\r\n\x1a\n"


def check_model(path: Path) -> None:
    """Refuse an MJCF that costs more than the limits allow, or that names a pipe or a device.

    Raises:
        ConfigError: It is such a model, or no XML: MuJoCo reads some of that, and what it reads is checked.
    """
    waiting, counts, parts = [path], dict[Path, int](), dict[Path, tuple[int, list[Path]]]()
    pixels = packed = 0
    while waiting:
        file = waiting.pop()
        check_size(file, limits().model_mib, "model_mib")
        if file in counts or not file.is_file():
            continue
        try:
            text = _COMMENT.sub("", file.read_text(encoding="utf-8", errors="replace"))
            if "\ufffd" in text:  # MuJoCo would read names that Python cannot
                raise ConfigError(f"{file}: no text in UTF-8; save it in that encoding")
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise ConfigError(
                f"MuJoCo cannot read {file.name!r}: it is no well-formed XML: {error}"
            ) from None
        counts[file] = check_elements(root, file)
        models = [path.parent / one.get("file", "") for one in root.iter("model")]
        parts[file] = len(list(root.iter("attach"))), models
        waiting += models + [path.parent / one.get("file", "") for one in root.iter("include")]
        folders = ("", *{one.get(key, "") for one in root.iter("compiler") for key in _FOLDERS} - {""})
        for one in root.iter():
            for name in [text for key, text in one.attrib.items() if key.startswith("file")]:
                for place in {path.parent / folder / name for folder in folders}:
                    pixels += _pixels(place)
                    packed += place.stat().st_size if place.is_file() else 0
    if sum(counts.values()) + _attached(path, counts, parts, 0) > limits().model_elements:
        raise ConfigError(f"{path}: {beyond('model_elements', 'its elements are')}")
    if pixels > max(limits().model_numbers, limits().growth * packed):
        raise ConfigError(f"{path}: {beyond('model_numbers', f'{pixels} pixels of its images are')}")


def _attached(
    file: Path, counts: Mapping[Path, int], parts: Mapping[Path, tuple[int, list[Path]]], depth: int
) -> int:
    """At most so many elements come from the models that a file attaches."""
    times, models = parts.get(file, (0, []))
    if depth > _DEEPEST:
        raise ConfigError(f"{file}: models are attached to each other more than {_DEEPEST} deep")
    each = [counts.get(one, 0) + _attached(one, counts, parts, depth + 1) for one in set(models)]
    return times * max(each, default=0)


def check_size(file: Path, most_mib: int, name: str) -> None:
    """Refuse a pipe, a device, and a file above a limit [MiB] of a name."""
    check_regular(file)
    if file.is_file() and file.stat().st_size > most_mib * 2**20:
        raise ConfigError(f"{file}: {beyond(name, 'its size is')}")


def _pixels(file: Path) -> int:
    """How many pixels a file has, if it is a PNG; else none."""
    check_size(file, limits().piece_mib, "piece_mib")
    if not file.is_file():
        return 0
    with file.open("rb") as opened:
        head = opened.read(24)
    return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24]) if head.startswith(_PNG) else 0


def check_elements(root: ElementTree.Element, path: Path) -> int:
    """How many elements a model file has, copies included; those that cost more count more.

    Raises:
        ConfigError: They, their sizes or the solver's iterations are beyond the limits.
    """
    waiting, elements, sizes, user = [(root, 1)], 0, 0, 0
    while waiting:
        one, times = waiting.pop()
        copies = prod(map(_number, one.get("count", "1").split()))
        elements += times * copies * _WEIGHTS.get(one.tag, 1)
        below = times * copies if one.tag == "replicate" else times
        numbers = _numbers(one)
        sizes += numbers * times if numbers > 1 else 0
        user = max([user, *(_number(text) for key, text in one.attrib.items() if key.startswith("nuser_"))])
        if elements > limits().model_elements:
            raise ConfigError(f"{path}: {beyond('model_elements', 'its elements are')}")
        if max(sizes, numbers, elements * user) > limits().model_numbers:
            most = max(sizes, numbers, elements * user)
            raise ConfigError(f"{path}: <{one.tag}>: {beyond('model_numbers', f'{most} numbers are')}")
        if (most := _iterations(one)) > limits().model_iterations:
            text = f"{most} iterations of a step are"
            raise ConfigError(f"{path}: <{one.tag}>: {beyond('model_iterations', text)}")
        waiting += [(child, below) for child in one]
    return elements


def _numbers(one: ElementTree.Element) -> int:
    """How many numbers an element asks for."""
    numbers = max(prod(_number(one.get(name, "1")) for name in names) for names in _SIZES)
    if one.tag == "size":
        return max(map(_number, one.attrib.values()), default=1)
    if one.tag == "numeric":
        return _number(one.get("size", "1"))
    if one.tag == "mesh" and "builtin" in one.attrib:  # its resolution in both directions
        return max(map(_number, one.get("params", "1").split()), default=1) ** 2
    return numbers


def _iterations(one: ElementTree.Element) -> int:
    """The most that solvers may iterate in a step, by the attributes of an <option>."""
    if one.tag != "option":
        return 0
    main = _number(one.get("iterations", "100")) * _number(one.get("ls_iterations", "50"))
    shapes = _number(one.get("sdf_iterations", "10")) * _number(one.get("sdf_initpoints", "40"))
    return max(main, shapes, *(_number(one.get(f"{name}_iterations", "50")) for name in ("noslip", "ccd")))


def _number(text: str) -> int:
    """A number in an attribute; 1 for what is none, as MuJoCo refuses it."""
    try:
        return max(1, int(float(text)))
    except (ValueError, OverflowError):
        return 1

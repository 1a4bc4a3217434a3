"""Make README's picture, a push and the report on it: `python docs/make_overview.py REPORT`.

REPORT is amhe-out/demo/report.html of `make demo`, the push above it docs/figures/t1.jpg.
It needs Chromium and a clone.
"""

from __future__ import annotations

import sys
from base64 import b64encode
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

FIGURES = Path(__file__).parent / "figures"
sys.path.insert(0, str(FIGURES.parents[1]))
from tests.view.browser import browser  # noqa: E402

#: Leaves two sections of the report, the first plots of the second, and puts the push above them.
ARRANGED = """(() => {
  const kept = ['Parameters', 'Measured against predicted'];
  const title = (one) => one.querySelector('h2')?.textContent;
  const sections = [...document.querySelectorAll('section')].filter((one) => kept.includes(title(one)));
  const push = Object.assign(new Image(), { src: 'data:image/jpeg;base64,%s' });
  push.style.cssText = 'display: block; width: 1280px; max-width: none; height: 207px; object-fit: cover';
  const styled = (names, css) => document.querySelectorAll(names).forEach((one) => one.style.cssText = css);
  styled('section > p:not(.legend), summary', 'display: none');
  styled('details', 'border: 0; margin: 0; padding: 0');
  for (const one of sections) one.style.cssText = 'margin: 8px 32px 0; padding: 0';
  document.body.replaceChildren(push, ...sections);
  document.body.style.cssText = 'margin: 0; padding: 0; max-width: none; background: white';
  return push.decode();
})()"""


def main() -> None:
    """Write docs/figures/overview.png."""
    path = FIGURES / "overview.png"
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch, browser(Path(scratch)) as one:
        one.open(Path(sys.argv[1]).resolve().as_uri(), 1280, 800)
        one.run(ARRANGED % b64encode((FIGURES / "t1.jpg").read_bytes()).decode())
        picture = Image.open(one.picture(path))
    picture.convert("RGB").quantize(256).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

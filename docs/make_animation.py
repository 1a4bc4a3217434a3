"""Make README's moving picture: `python docs/make_animation.py FOUND`, in a clone with Chromium.

FOUND is the result of the double pendulum's command in docs/real.md. The picture is its view for twelve
seconds: four clips of a real log that was not fitted, as measured and as predicted from their first states.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))
from tests.view.browser import browser  # noqa: E402

#: Seconds of a clip, pictures of a second, and how many clips: those that the owners' model misses most.
SECONDS, RATE, CLIPS = 3.0, 10, 4
#: Picture that it begins with: the predictions have parted there, for readers to whom it stands still.
_PARTED = 18
#: Leaves the scene, seen along the joints' axes, and the plots beside it.
ARRANGED = """(() => {
  const hide = "header, #notes, #transport, #clips, #parameters, #plots h2, #layers label:nth-child(n+4)";
  document.querySelectorAll(hide).forEach((one) => one.style.display = 'none');
  const [stage, plots] = ['stage', 'plots'].map((name) => document.getElementById(name));
  document.querySelector('main').style.cssText =
    'display: grid; grid-template-columns: 380px 1fr; gap: 16px';
  for (const one of [stage, plots])
    one.style.cssText = 'grid-area: auto; margin: 0; height: 380px; min-height: 0';
  document.querySelector('#panels .panels').style.setProperty('--across', 1);
  document.body.style.cssText = 'padding: 10px; margin: 0; max-width: none';
  player.stage.camera.around = -Math.PI / 2; player.stage.camera.above = 0.05;
  const held = player.takes.filter((take) => take.held && take.costs.at(-1) < 4);
  window.chosen = held.sort((a, b) => b.costs[0] - a.costs[0]).slice(0, %d);
})()"""
#: Shows a share of a clip.
SHOW = """(() => {
  const take = chosen[%d];
  if (player.take !== take) {
    player.take = take; player.row = take.recording;
    player.fit(); player.redraw(); scrollTo(0, 0);
    const camera = player.stage.camera;  // all of it below the layers' names
    camera.away *= 1.15; camera.moved = [0, 0, 0.05 * camera.away];
  }
  player.seek(take.start + %.4f * (take.stop - take.start)); player.paint();
  return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
})()"""


def main() -> None:
    """Write docs/figures/double_pendulum.webp."""
    path, frames = DOCS / "figures" / "double_pendulum.webp", []
    with TemporaryDirectory(ignore_cleanup_errors=True) as scratch, browser(Path(scratch)) as one:
        one.open((Path(sys.argv[1]) / "view.html").resolve().as_uri(), 860, 400)
        one.run(ARRANGED % CLIPS)
        for frame in range(round(CLIPS * SECONDS * RATE)):
            clip, share = divmod(frame / (SECONDS * RATE), 1.0)
            one.run(SHOW % (clip, share))
            picture = Image.open(one.picture(Path(scratch) / "frame.png"))
            frames.append(picture.convert("RGB"))
    first, *rest = frames[_PARTED:] + frames[:_PARTED]
    first.save(
        path, save_all=True, append_images=rest, duration=round(1e3 / RATE), loop=0, quality=60, method=4
    )
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

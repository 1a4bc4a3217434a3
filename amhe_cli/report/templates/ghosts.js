// Pictures of a clip at some instants: one scene, drawn once for each, as the view draws it.
function strip(box) {
  const data = JSON.parse(box.querySelector("script").textContent), canvas = made("canvas");
  canvas.style.cssText = "position:absolute;left:-9999px;width:400px;height:300px"; box.append(canvas);
  let stage;
  try { stage = new Stage(canvas, data); } catch { box.hidden = true; return; }
  const pictures = data.times.map((time) => {
    const picture = made("canvas", { width: 400, height: 300 });
    picture.setAttribute("role", "img"); picture.setAttribute("aria-label", `The scene at ${time.toFixed(2)} s`);
    box.append(made("div", {}, picture, made("span", { textContent: `${time.toFixed(2)} s` })));
    return picture;
  });
  const frames = data.frames.map((frame) => frame.map(floats));
  stage.camera.away = stage.distance(frames.map(([own]) => [own, stage.middle(own)]));
  const paint = () => {
    const colors = { sky: rgb("faint"), ground: rgb("rule"), grid: rgb("prior"), dark: isDark() };
    frames.forEach(([own, ...ghosts], i) => {
      const layers = ghosts.map((poses, k) => ({ poses, tint: rgb(data.candidates[k]), opacity: 0.5 })).reverse();
      stage.draw([{ poses: own, opacity: 1 }, ...layers], stage.middle(own), colors, {});
      pictures[i].getContext("2d").drawImage(canvas, 0, 0, 400, 300);
    });
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint); paint();
}
for (const box of document.querySelectorAll(".ghosts")) strip(box);

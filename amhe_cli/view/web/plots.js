// Panels of curves that share the scene's time. A panel is { title, unit, lines(from, to) }; a line is
// { color, times, values, lower, upper, dots, dash }.
const PANELS = 12;

class Plots {
  constructor(box, seek) { Object.assign(this, { box, seek, panels: [], from: 0, to: 1, hover: null }); }
  show(panels) {
    this.box.replaceChildren(); this.panels = [];
    for (const panel of panels.slice(0, PANELS)) {
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      const name = document.createElement("span"), number = document.createElement("span"), canvas = document.createElement("canvas");
      name.textContent = panel.title + (panel.unit ? ` [${panel.unit}]` : "");
      canvas.setAttribute("role", "img"); canvas.setAttribute("aria-label", `${panel.title} over time`);
      caption.append(name, number); figure.append(caption, canvas); this.box.append(figure);
      const whole = { ...panel, canvas, number, still: null };
      const time = (event) => this.from + (this.to - this.from) * Math.min(1, Math.max(0, (event.offsetX - EDGE) / (canvas.clientWidth - EDGE - 4)));
      canvas.addEventListener("pointerdown", (event) => this.seek(time(event)));
      canvas.addEventListener("pointermove", (event) => { if (event.buttons) this.seek(time(event)); else { this.hover = time(event); this.cursor(this.now); } });
      canvas.addEventListener("pointerleave", () => { this.hover = null; this.cursor(this.now); });
      this.panels.push(whole);
    }
  }
  // Draws all curves anew, between two times.
  draw(from, to, colors) {
    Object.assign(this, { from, to, colors });
    for (const panel of this.panels) this.curves(panel);
  }
  curves(panel) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), { canvas } = panel, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    const still = panel.still = document.createElement("canvas");
    still.width = canvas.width; still.height = canvas.height;
    const paper = still.getContext("2d"), lines = panel.drawn = panel.lines(this.from, this.to);
    paper.scale(ratio, ratio);
    let low = Infinity, high = -Infinity;
    const measure = (line, ...all) => { for (const values of all) for (let i = 0; i < line.times.length; i++) if (line.times[i] >= this.from && line.times[i] <= this.to && Number.isFinite(values[i])) { low = Math.min(low, values[i]); high = Math.max(high, values[i]); } };
    for (const line of lines.filter((line) => line.frames !== false)) measure(line, line.values);
    const measured = [low, high];
    for (const line of lines.filter((line) => line.frames === false)) measure(line, line.values);
    if (Number.isFinite(measured[0])) {  // a curve that runs away must not flatten the others
      const most = Math.max(2 * (measured[1] - measured[0]), 1e-9);
      low = Math.max(low, measured[0] - most); high = Math.min(high, measured[1] + most);
    }
    for (const line of lines.filter((line) => line.lower)) measure(line, line.lower, line.upper);
    if (!Number.isFinite(low)) [low, high] = [0, 1];
    const margin = 0.08 * (high - low) || 0.1 * Math.abs(high) || 1;
    low -= margin; high += margin;
    const x = (time) => EDGE + (time - this.from) / (this.to - this.from || 1) * (width - EDGE - 4), y = (value) => height - 16 - (value - low) / (high - low) * (height - 20);
    paper.font = "10px system-ui, sans-serif"; paper.fillStyle = this.colors.soft; paper.strokeStyle = this.colors.rule; paper.lineWidth = 1;
    for (const tick of ticks(low, high, 3)) {
      paper.beginPath(); paper.moveTo(EDGE, y(tick.value)); paper.lineTo(width - 4, y(tick.value)); paper.stroke();
      paper.textAlign = "right"; paper.fillText(tick.text, EDGE - 4, y(tick.value) + 3);
    }
    const times = ticks(this.from, this.to, 3);
    times.forEach((tick, i) => { const last = i === times.length - 1; paper.textAlign = "center"; paper.fillText(tick.text + (last ? " s" : ""), Math.min(x(tick.value), width - 12), height - 3); });
    paper.save(); paper.beginPath(); paper.rect(EDGE, 0, width - EDGE - 4, height - 15); paper.clip();
    for (const line of lines) this.curve(paper, line, x, y);
    paper.restore();
    Object.assign(panel, { x, ratio, height });
  }
  curve(paper, { color, times, values, lower, upper, dots, dash }, x, y) {
    if (lower) {
      paper.fillStyle = color; paper.globalAlpha = 0.18; paper.beginPath();
      for (let i = 0; i < times.length; i++) paper.lineTo(x(times[i]), y(lower[i]));
      for (let i = times.length - 1; i >= 0; i--) paper.lineTo(x(times[i]), y(upper[i]));
      paper.fill(); paper.globalAlpha = 1;
    }
    paper.strokeStyle = paper.fillStyle = color; paper.lineWidth = 1.4; paper.setLineDash(dash ? [4, 3] : []);
    if (dots) { for (let i = 0; i < times.length; i++) if (Number.isFinite(values[i])) paper.fillRect(x(times[i]) - 1, y(values[i]) - 1, 2, 2); return; }
    paper.beginPath();
    let broken = true;
    for (let i = 0; i < times.length; i++) {
      if (!Number.isFinite(values[i])) { broken = true; continue; }
      if (broken) paper.moveTo(x(times[i]), y(values[i])); else paper.lineTo(x(times[i]), y(values[i]));
      broken = false;
    }
    paper.stroke(); paper.setLineDash([]);
  }
  // Moves the line of the present time, and shows the numbers there, or where the pointer is.
  cursor(now) {
    this.now = now;
    for (const panel of this.panels) {
      if (!panel.still) continue;
      const paper = panel.canvas.getContext("2d");
      paper.setTransform(1, 0, 0, 1, 0, 0); paper.clearRect(0, 0, panel.canvas.width, panel.canvas.height); paper.drawImage(panel.still, 0, 0);
      paper.scale(panel.ratio, panel.ratio);
      for (const [time, color] of [[now, this.colors.ink], [this.hover, this.colors.soft]]) {
        if (time === null || time < this.from || time > this.to) continue;
        paper.strokeStyle = color; paper.lineWidth = 1; paper.beginPath(); paper.moveTo(panel.x(time), 0); paper.lineTo(panel.x(time), panel.height - 15); paper.stroke();
      }
      const time = this.hover ?? now, found = new Map();
      for (const line of panel.drawn) { const value = near(line, time); if (value !== null) found.set(line.label ?? "", { value, color: line.color }); }
      const values = [...found].map(([title, { value, color }]) => { const one = document.createElement("b"); Object.assign(one, { title, textContent: brief(value) }); one.style.color = color; return one; });
      panel.number.replaceChildren(this.hover === null ? "" : `${time.toFixed(2)} s: `, ...values);
    }
  }
}
const EDGE = 42;

const brief = (value) => Math.abs(value) >= 1e4 || (value && Math.abs(value) < 1e-3) ? value.toExponential(1) : String(Number(value.toPrecision(3)));
function near({ times, values }, time) {
  let low = 0, high = times.length - 1;
  if (high < 0 || time < times[0] - 0.05 || time > times[high] + 0.05) return null;
  while (high - low > 1) { const middle = (low + high) >> 1; if (times[middle] > time) high = middle; else low = middle; }
  const value = values[Math.abs(times[high] - time) < Math.abs(times[low] - time) ? high : low];
  return Number.isFinite(value) ? value : null;
}
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw || 1));
  const step = [1, 2, 5, 10].map((s) => s * power).find((s) => s >= raw / 1.7) || 1, out = [];  // two of them fit always
  const digits = Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) out.push({ value, text: digits > 4 ? value.toExponential(0) : value.toFixed(digits) });
  return out;
}

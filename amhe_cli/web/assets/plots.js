// Figures of curves: panels side by side under one legend. Where the pointer is, the nearest sample of each line is
// marked, and its numbers stand above its panel. Dragging zooms in on x, a double click shows all again.
const LEFT = 48, RIGHT = 10, TOP = 6, BOTTOM = 34;
const $ = (id) => document.getElementById(id);
const made = (name, more = {}, ...children) => { const one = Object.assign(document.createElement(name), more); one.append(...children); return one; };
const drawn = (name, more = {}, ...children) => {
  const one = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(more)) one.setAttribute(key, value);
  one.append(...children); return one;
};
const ink = (color) => `var(--${color})`;
// Red, green and blue of a colour, between 0 and 1, on the reader's screen.
const rgb = (color) => {
  const probe = document.body.appendChild(made("i")); probe.style.color = ink(color);
  const parts = getComputedStyle(probe).color.match(/[\d.]+/g).slice(0, 3).map((part) => Number(part) / 255);
  probe.remove(); return parts;
};
const css = ([r, g, b]) => `rgb(${[r, g, b].map((part) => Math.round(255 * part))})`;
const isDark = () => rgb("back")[0] < 0.5;
const minus = (text) => text.replace("-", "\u2212");
const brief = (value) => minus(Math.abs(value) >= 1e4 || (value && Math.abs(value) < 1e-3) ? value.toExponential(1) : String(Number(value.toPrecision(3))));
// With as many digits as tell 200 places of a range apart.
const precise = (value, [low, high]) => {
  const places = Math.min(Math.max(0, Math.ceil(Math.log10(200 / Math.max(high - low, 1e-12)))), 8);
  return minus((Number(value.toFixed(places)) + 0).toFixed(places));  // no -0
};

// A box of panels. A panel is { title, unit, x, lines, marks, log, low, high, equal, height }, a line { name, color, shape,
// x, y, lower, upper, leads }; instead of lines there may be a function from the ends of x to lines.
class Plots {
  constructor(box, { across = 3, wide = false, seek = null } = {}) {
    Object.assign(this, { box, wide, seek, panels: [], seen: null, now: null });
    this.key = made("p", { className: "legend" }); this.grid = made("div", { className: "panels" });
    this.grid.style.setProperty("--across", across); box.append(this.key, this.grid);
    new ResizeObserver(() => { if (this.width !== this.grid.clientWidth) { this.width = this.grid.clientWidth; this.draw(); } }).observe(this.grid);
  }
  show(panels) {
    this.panels = panels.map((panel) => new Panel(this, panel));
    this.grid.replaceChildren(...this.panels.map((one) => one.figure));
    if (this.wide && panels.length > 1) this.panels[0].figure.classList.add("alone");
    this.draw();
  }
  // Draws all panels anew, between two ends of x; null: all there is.
  draw(seen = this.seen) {
    this.seen = seen;
    for (const panel of this.panels) panel.draw();
    this.legend(); this.cursor(this.now);
  }
  legend() {
    const keys = new Map();
    for (const panel of this.panels) for (const one of [...(panel.lines ?? []), ...(panel.marks ?? [])]) if (one.name && !keys.has(one.name)) keys.set(one.name, one);
    if (keys.size === 1 && !this.panels.some((panel) => panel.marks?.length)) keys.clear();  // nothing to tell apart
    this.key.replaceChildren(...[...keys].map(([name, one]) => {
      const shape = one.at === undefined ? one.shape ?? "line" : Array.isArray(one.at) ? "patch" : "dotted";
      const sign = made("i", { className: shape }); sign.style.setProperty("--c", ink(one.color));
      return made("span", {}, sign, name);
    }));
    this.key.hidden = !keys.size;
  }
  // The numbers of all panels over the same x at a place; null: none, or those of the present time.
  point(panel, x, y) { for (const one of this.panels) if (one.across === panel.across) one.point(x, one === panel ? y : null); }
  cursor(now) { this.now = now; for (const panel of this.panels) panel.cursor(now); }
}

class Panel {
  constructor(plots, panel) {
    const { title, unit = "", x = "time [s]", marks = [], height = 150 } = panel;
    Object.assign(this, { plots, panel, marks, height, across: x, scatter: !x.startsWith("time") });
    this.number = made("span"); this.svg = drawn("svg", { role: "img", "aria-label": `${title} over ${x}` });
    this.figure = made("div", { className: "panel" }, made("div", { className: "caption" }, made("span", { textContent: title + (unit ? ` [${unit}]` : "") }), this.number), this.svg);
    this.handle();
  }
  draw() {
    const { panel, svg } = this, width = this.figure.clientWidth, [from, to] = this.plots.seen ?? [null, null];
    if (!width) return;  // in what is closed
    this.lines = typeof panel.lines === "function" ? panel.lines(from, to) : panel.lines;
    this.x = from === null ? this.ends("x") : [from, to];
    this.y = this.ends("y");
    const wide = width - LEFT - RIGHT;
    if (panel.equal) this.height = Math.min(wide * (this.y[1] - this.y[0]) / (this.x[1] - this.x[0]), 520) + TOP + BOTTOM;
    this.size = [wide, this.height - TOP - BOTTOM];
    if (panel.equal) this.size[0] = this.size[1] * (this.x[1] - this.x[0]) / (this.y[1] - this.y[0]);
    svg.setAttribute("width", width); svg.setAttribute("height", this.height);
    const frame = drawn("svg", { x: LEFT, y: TOP, width: this.size[0], height: this.size[1] });  // it clips what leaves it
    frame.append(...this.marks.map((mark) => this.mark(mark)), ...this.lines.flatMap((line) => this.curve(line)));
    this.pointer = drawn("g"); this.present = drawn("line", { class: "present", y2: this.size[1], visibility: "hidden" });
    frame.append(this.present, this.pointer); svg.replaceChildren(...this.axes(), frame);
  }
  // Ends of an axis: those of the lines that lead; what runs away from them must not flatten them.
  ends(axis) {
    const { panel, scatter } = this, time = axis === "x" && !scatter, log = panel.log && axis === "y";
    const values = (line) => axis === "x" ? [line.x] : [line.y, line.lower ?? [], line.upper ?? []].map((some) => Array.from(some).filter((_, i) => line.x[i] >= this.x[0] && line.x[i] <= this.x[1]));
    const [leads, others] = [true, false].map((lead) => this.lines.filter((line) => (line.leads !== false || time) === lead).flatMap(values));
    if (axis === "y") others.push(this.marks.filter((mark) => mark.axis === "y").flatMap(({ at }) => at));
    const all = spread(others), own = spread(leads);
    let [low, high] = own ?? all ?? [0, 1];
    if (own && all) {
      const most = Math.max(2 * (high - low), 1e-9);
      [low, high] = [Math.max(Math.min(all[0], low), low - most), Math.min(Math.max(all[1], high), high + most)];
    }
    const whole = time && !this.lines.some(few);
    const margin = whole || panel.equal ? 0 : (axis === "x" ? 0.03 : 0.08) * (high - low) || 0.1 * Math.abs(high) || 1;
    if (axis === "x") return low < high ? [low - margin, high + margin] : [low - 0.5, high + 0.5];
    return log ? [panel.low ?? low / 1.2, panel.high ?? high * 1.2] : [panel.low ?? low - margin, panel.high ?? high + margin];
  }
  place(x, y) {
    const share = (v, [low, high], log) => log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low || 1);
    return [this.size[0] * share(x, this.x), this.size[1] * (1 - share(y, this.y, this.panel.log))];
  }
  axes() {
    const [wide, high] = this.size, texts = [];
    for (const { value, text } of ticks(...this.y, Math.max(2, Math.round(high / 45)), this.panel.log)) {
      const y = TOP + this.place(this.x[0], value)[1];
      texts.push(drawn("line", { x1: LEFT, x2: LEFT + wide, y1: y, y2: y }), drawn("text", { x: LEFT - 6, y: y + 3.5, "text-anchor": "end" }, text));
    }
    for (const { value, text } of ticks(...this.x, Math.max(2, Math.round(wide / 80)))) {
      const x = LEFT + this.place(value, this.y[0])[0];
      texts.push(drawn("line", { x1: x, x2: x, y1: TOP, y2: TOP + high }), drawn("text", { x: Math.min(x, LEFT + wide + RIGHT - 3.1 * text.length), y: TOP + high + 14, "text-anchor": "middle" }, text));
    }
    return [drawn("g", { class: "axes" }, ...texts, drawn("text", { x: LEFT + wide, y: TOP + high + 27, "text-anchor": "end" }, this.across))];
  }
  mark({ at, color, axis }) {
    const ends = [at].flat(), [wide, high] = this.size;
    const [a, b] = ends.map((v) => axis === "y" ? this.place(this.x[0], v)[1] : this.place(v, this.y[1])[0]);
    if (b !== undefined) return drawn("rect", { ...(axis === "y" ? { x: 0, width: wide, y: Math.min(a, b), height: Math.abs(b - a) } : { x: a, width: Math.max(b - a, 1), y: 0, height: high }), style: `fill:${ink(color)}`, class: "shade" });
    return drawn("line", { ...(axis === "y" ? { x2: wide, y1: a, y2: a } : { x1: a, x2: a, y2: high }), style: `stroke:${ink(color)}`, class: "mark" });
  }
  curve(line) {
    const { x, y, lower, upper, color, shape = "line" } = line, parts = [], at = (i, values) => this.place(x[i], values[i]).map((v) => v.toFixed(1)).join(" ");
    const known = (i, values) => values[i] !== null && Number.isFinite(values[i]), style = `--c:${ink(color)}`;
    if (lower) {
      const some = Array.from(x.keys()).filter((i) => known(i, lower) && known(i, upper));
      const there = (values, i, k) => shape === "step" && k ? `H${this.place(x[i], 1)[0].toFixed(1)}V${this.place(x[i], values[i])[1].toFixed(1)}` : `L${at(i, values)}`;
      const back = some.toReversed().map((i, k, all) => shape === "step" && k ? `V${this.place(x[all[k]], lower[all[k]])[1].toFixed(1)}H${this.place(x[i], 1)[0].toFixed(1)}` : `L${at(i, lower)}`);
      if (some.length) parts.push(drawn("path", { class: "band", style, d: `M${at(some[0], upper)}${some.map((i, k) => there(upper, i, k)).join("")}${back.join("")}Z` }));
    }
    let d = "", broken = true;
    for (let i = 0; i < x.length; i++) {
      if (!known(i, y)) { broken = true; continue; }
      if (shape === "dots") d += `M${at(i, y)}h0`;
      else if (shape === "step" && !broken) { const [px, py] = this.place(x[i], y[i]); d += `H${px.toFixed(1)}V${py.toFixed(1)}`; }
      else d += `${broken ? "M" : "L"}${at(i, y)}`;
      broken = false;
    }
    parts.push(drawn("path", { class: few(line) ? "dots few" : shape, style, d: shape === "area" ? `${d}Z` : d }));
    return parts;
  }
  handle() {
    const { svg, plots } = this, value = (event) => this.x[0] + (this.x[1] - this.x[0]) * Math.min(1, Math.max(0, (event.offsetX - LEFT) / this.size[0]));
    let from = null;
    svg.addEventListener("pointermove", (event) => {
      if (!this.lines) return;
      if (plots.seek && event.buttons) return plots.seek(value(event));
      plots.point(this, value(event), event.offsetY - TOP);
      if (from !== null) { const [a, b] = [from, value(event)].map((v) => this.place(v, this.y[0])[0]); this.pointer.append(drawn("rect", { class: "zoom", x: Math.min(a, b), width: Math.abs(a - b), height: this.size[1] })); }
    });
    svg.addEventListener("pointerleave", () => { for (const panel of plots.panels) panel.cursor(plots.now); });
    svg.addEventListener("pointerdown", (event) => {
      if (plots.seek) return plots.seek(value(event));
      if (event.pointerType !== "touch" && !event.button && !this.panel.equal) { from = value(event); svg.setPointerCapture(event.pointerId); event.preventDefault(); }
    });
    svg.addEventListener("pointerup", (event) => {
      const ends = [from, value(event)].sort((a, b) => a - b), was = from; from = null;
      if (was !== null && this.place(ends[1], 1)[0] - this.place(ends[0], 1)[0] > 8) plots.draw(ends);
    });
    svg.addEventListener("dblclick", () => plots.seek || plots.draw(null));
  }
  // The sample of each line that is nearest to a place: of dots over no time the one nearest to the pointer.
  point(x, y = null) {
    if (!this.lines) return;
    const named = this.lines.filter((line) => line.name && line.x.length), first = named.find((line) => line.shape === "dots") ?? named[0];
    this.pointer.replaceChildren();
    if (!first) return;
    const [px] = this.place(x, this.y[0]), flat = this.scatter && y !== null, at = (line, i) => this.place(line.x[i], line.y[i]);
    const closest = (line) => nearest(line, flat ? (i) => Math.hypot(at(line, i)[0] - px, at(line, i)[1] - y) : (i) => Math.abs(line.x[i] - x));
    const own = closest(first), there = own === null ? x : first.x[own];
    const found = flat ? [[first, own]] : named.map((line) => [line, line === first ? own : nearest(line, (i) => Math.abs(line.x[i] - there))]);
    const texts = new Map();
    for (const [line, i] of found) {
      if (i === null || (!flat && line.shape !== "step" && Math.abs(line.x[i] - there) > 0.05 * (this.x[1] - this.x[0]))) continue;
      const [cx, cy] = at(line, i);
      this.pointer.append(drawn("circle", { cx, cy, r: 3.5, style: `--c:${ink(line.color)}` }));
      texts.set(line.name, { value: line.y[i], color: line.color });
    }
    if (!flat) this.pointer.append(drawn("line", { x1: this.place(there, 1)[0], x2: this.place(there, 1)[0], y2: this.size[1] }));
    if (texts.has("measured") && texts.has("after")) texts.set("measured \u2212 after", { value: texts.get("measured").value - texts.get("after").value, color: "soft" });
    const unit = this.across.match(/\[(.*)\]/)?.[1] ?? "";
    this.number.replaceChildren(`${precise(there, this.x)} ${unit}`, ...[...texts].map(([name, { value, color }]) => {
      const one = made("b", { title: name, textContent: (name.startsWith("measured \u2212") ? "\u0394\u00a0" : "") + (this.panel.log ? brief(value) : precise(value, this.y)) });
      one.style.color = ink(color); return one;
    }));
  }
  // The line of the present time with its numbers, where a scene plays, whose clock says the time; else none.
  cursor(now) {
    if (!this.lines || !this.pointer) return;
    this.pointer.replaceChildren(); this.number.replaceChildren();
    const shown = now !== null && now >= this.x[0] && now <= this.x[1];
    this.present.setAttribute("visibility", shown ? "visible" : "hidden");
    if (!shown) return;
    this.point(now); this.pointer.replaceChildren(); this.number.firstChild?.remove();
    const [x] = this.place(now, this.y[0]); this.present.setAttribute("x1", x); this.present.setAttribute("x2", x);
  }
}

function spread(arrays) {
  let low = Infinity, high = -Infinity;
  for (const values of arrays) for (const value of values) if (value !== null && Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
  return Number.isFinite(low) ? [low, high] : null;  // of no number
}
function nearest(line, distance) {
  let best = null, least = Infinity;
  for (let i = 0; i < line.x.length; i++) { const d = line.y[i] !== null && Number.isFinite(line.y[i]) ? distance(i) : Infinity; if (d < least) { least = d; best = i; } }
  return best;
}
// Dots that stand alone, and must be seen.
const few = (line) => line.shape === "dots" && line.x.length < 12;
// Round numbers between two ends, and their texts.
function ticks(low, high, count, log = false) {
  if (log && high / low > 6) {
    const every = high / low > 1e3 ? [1] : [1, 2, 5], found = [];
    for (let power = 10 ** Math.floor(Math.log10(low)); power <= high; power *= 10) found.push(...every.map((k) => k * power));
    return found.filter((v) => low <= v && v <= high).map((value) => ({ value, text: brief(value) }));
  }
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw || 1)), steps = [0.2, 0.5, 1, 2, 5, 10].map((s) => s * power), out = [];
  const fit = (step) => Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1;
  const wanted = steps.find((s) => s >= raw / 1.7) || 1, step = steps.findLast((s) => s <= wanted && fit(s) > 1) ?? wanted;  // one alone is no scale
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), tiny = digits > 4 && Math.max(Math.abs(low), Math.abs(high)) < 1e-3;
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push({ value: k * step, text: minus(tiny ? (k * step).toExponential(0) : (k * step).toFixed(digits)) });
  return out;
}

for (const box of document.querySelectorAll("figure.plots")) {
  const { panels, across, wide } = JSON.parse(box.querySelector("script").textContent);
  new Plots(box, { across, wide }).show(panels);
}

// Figures: the numbers under the pointer; drag to zoom in, double click to see all again.
const reading = (share, [low, high, log]) => log ? low * (high / low) ** share : low + share * (high - low);
const digits = (v, [low, high]) => String(Number(v.toPrecision(Math.max(3, Math.ceil(Math.log10(Math.abs(v) / Math.abs(high - low) || 1)) + 3))));
const number = (text) => Number(text.replace("\u2212", "-"));

// Round numbers between two ends, and their texts.
function rounds(low, high, log) {
  if (log && high / low > 8) {
    const every = high / low > 1e4 ? [1] : [1, 2, 5], found = [];
    for (let power = 10 ** Math.floor(Math.log10(low)); power <= high; power *= 10) found.push(...every.map((k) => k * power));
    return found.filter((v) => low <= v && v <= high).map((v) => [v, String(Number(v.toPrecision(1)))]);
  }
  const raw = (high - low) / 5, power = 10 ** Math.floor(Math.log10(raw)), step = power * [1, 2, 5, 10].find((k) => k * power >= raw * 0.999);
  const places = Math.min(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), 9), first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(0, Math.floor(high / step + 1e-9) - first + 1) }, (_, i) => (first + i) * step)
    .map((v) => [v, v.toFixed(places).replace("-", "\u2212")]);
}

// One pair of axes. Lines, areas and labels in it move with a zoom, and its ticks are made anew.
class Axes {
  constructor(group, { box, x, y }) {
    Object.assign(this, { group, box, ends: { x, y }, seen: { x: [0, 1], y: [0, 1] } });
    const [left, top, right, bottom] = box, clipped = (one) => one.matches("[clip-path]") ? one : one.querySelector("[clip-path]");
    const children = [...group.children], drawn = children.filter((one) => !one.id.startsWith("matplotlib.") && clipped(one));
    this.labels = children.filter((one) => one.id.startsWith("text")).map((one) => ({ one, at: this.place(one.querySelector("text")) }))
      .filter(({ at: [px, py] }) => left <= px && px <= right && top <= py && py <= bottom);
    this.ticks = Object.fromEntries(["x", "y"].map((name) => [name, [...group.querySelectorAll(`g[id^=${name}tick]`)]]));
    // What lies below the grid and what lies above it, each in a frame that clips it.
    const grid = children.findLastIndex((one) => one.id.startsWith("matplotlib.")), above = (one) => children.indexOf(one) > grid;
    this.moving = [drawn.filter((one) => !above(one)), drawn.filter(above)].filter((some) => some.length).map((some) => {
      const frame = document.createElementNS(group.namespaceURI, "g"), moving = frame.cloneNode();
      frame.setAttribute("clip-path", clipped(some[0]).getAttribute("clip-path"));
      some[0].before(frame); frame.append(moving); moving.append(...some);
      for (const one of moving.querySelectorAll("[clip-path]")) one.removeAttribute("clip-path");
      return moving;
    });
    this.dots = this.moving.flatMap((one) => [...one.querySelectorAll("[id^=line2d] use, [id^=PathCollection] use")]);
  }
  // The place of a text or of a grid line.
  place(one) {
    return one.tagName === "text" ? ["x", "y"].map((name) => Number(one.getAttribute(name))) : one.getAttribute("d").match(/-?[\d.]+/g).slice(0, 2).map(Number);
  }
  range(name) { const [from, to] = this.seen[name], ends = this.ends[name]; return [reading(from, ends), reading(to, ends), ends[2]]; }
  // Numbers at a place, and shares of the box there.
  at(px, py) {
    const [left, top, right, bottom] = this.box, shares = { x: (px - left) / (right - left), y: (bottom - py) / (bottom - top) };
    return { shares, text: ["x", "y"].map((name) => digits(reading(shares[name], this.range(name)), this.range(name))).join(", ") };
  }
  // Where a place goes.
  moved(px, py) {
    const [left, top, right, bottom] = this.box, { x: [x0, x1], y: [y0, y1] } = this.seen;
    return [left + (px - left - x0 * (right - left)) / (x1 - x0), bottom - (bottom - py - y0 * (bottom - top)) / (y1 - y0)];
  }
  draw() {
    const { x: [x0, x1], y: [y0, y1] } = this.seen, [px, py] = this.moved(0, 0), whole = x1 - x0 === 1 && y1 - y0 === 1;
    for (const one of this.moving) {
      one.setAttribute("class", whole ? "" : "zoomed"); one.setAttribute("transform", `matrix(${1 / (x1 - x0)} 0 0 ${1 / (y1 - y0)} ${px} ${py})`);
    }
    for (const dot of this.dots) {
      const [at, to] = ["x", "y"].map((name) => Number(dot.getAttribute(name)));
      dot.setAttribute("transform", `translate(${at} ${to}) scale(${x1 - x0} ${y1 - y0}) translate(${-at} ${-to})`);
    }
    for (const { one, at } of this.labels) this.move(one, at, this.moved(...at));
    for (const name of ["x", "y"]) this.axis(name, this.seen[name][1] - this.seen[name][0] === 1);
  }
  axis(name, whole) {
    const ticks = this.ticks[name], along = name === "x" ? 0 : 1, [left, top, right, bottom] = this.box, range = this.range(name);
    for (const old of this.group.querySelectorAll(`.${name}-new`)) old.remove();
    const named = ticks.some((one) => Number.isNaN(number(one.querySelector("text")?.textContent ?? "0")));
    const from = (one) => this.place(one.querySelector("path") ?? one.querySelector("text"));
    for (const one of ticks) {
      one.style.display = whole || named ? "" : "none";
      if (named) this.move(one, from(one), this.moved(...from(one)), along);
    }
    if (whole || named || !ticks.length) return;
    for (const [v, text] of rounds(...range)) {
      const [low, high, log] = range, share = log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low);
      const to = [left + share * (right - left), bottom - share * (bottom - top)], one = ticks[0].cloneNode(true), words = one.querySelector("text");
      one.removeAttribute("id"); one.setAttribute("class", `${name}-new`); one.style.display = "";
      for (const line of one.querySelectorAll("[clip-path]")) line.removeAttribute("clip-path");
      if (words) words.textContent = text;
      ticks[0].before(one); this.move(one, from(ticks[0]), to, along);
    }
  }
  // Moves an element from a place to another, along one axis or both; outside the box it is not shown.
  move(one, from, to, along = null) {
    const [left, top, right, bottom] = this.box, by = to.map((v, k) => along === null || along === k ? v - from[k] : 0);
    const inside = [left - 1 <= to[0] && to[0] <= right + 1, top - 1 <= to[1] && to[1] <= bottom + 1];
    one.setAttribute("transform", `translate(${by})`); one.style.visibility = (along === null ? inside[0] && inside[1] : inside[along]) ? "" : "hidden";
  }
}

for (const svg of document.querySelectorAll("svg[data-axes]")) {
  const groups = svg.querySelectorAll("g[id^=axes_]"), tip = document.createElement("div");
  const axes = JSON.parse(svg.dataset.axes).map((one, i) => new Axes(groups[i], one));
  tip.className = "tip"; tip.hidden = true; document.body.append(tip);
  let from = null, frame = null, chosen = null;
  const place = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  const under = ({ x, y }) => axes.find(({ box: [l, t, r, b] }) => l <= x && x <= r && t <= y && y <= b);
  const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);
  // Zooms to shares of a pair of axes; those in the same column with the same ends go along x with it.
  const zoom = (one, x, y) => {
    for (const other of axes) {
      const column = same([other.box[0], other.box[2], other.ends.x], [one.box[0], one.box[2], one.ends.x]);
      if (column || same(other.box, one.box)) other.seen.x = x;
      if (same(other.box, one.box)) other.seen.y = y;
      other.draw();
    }
  };
  svg.addEventListener("pointermove", (event) => {
    const { x, y } = place(event), one = under({ x, y });
    tip.hidden = !one;
    if (one) {
      tip.textContent = one.at(x, y).text;
      tip.style.left = `${Math.min(event.clientX + 12, innerWidth - tip.offsetWidth - 4)}px`; tip.style.top = `${event.clientY + 12}px`;
    }
    if (frame) for (const [name, v] of Object.entries({ x: Math.min(x, from.x), y: Math.min(y, from.y), width: Math.abs(x - from.x), height: Math.abs(y - from.y) })) frame.setAttribute(name, v);
  });
  svg.addEventListener("pointerleave", () => tip.hidden = true);
  svg.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" || event.button || !(chosen = under(place(event)))) return;
    event.preventDefault(); from = place(event); svg.setPointerCapture(event.pointerId);
    frame = svg.appendChild(document.createElementNS(svg.namespaceURI, "rect"));
    frame.setAttribute("class", "frame");
  });
  svg.addEventListener("pointerup", (event) => {
    if (!frame) return;
    const { x, y } = place(event), [a, b] = [from, { x, y }].map((one) => chosen.at(one.x, one.y).shares);
    frame.remove(); frame = null;
    if (Math.abs(x - from.x) < 8 || Math.abs(y - from.y) < 8) return;
    const [along, up] = ["x", "y"].map((name) => {
      const [low, high] = chosen.seen[name], ends = [a[name], b[name]].map((share) => low + Math.min(1, Math.max(0, share)) * (high - low));
      return ends.sort((one, other) => one - other);
    });
    zoom(chosen, along, up);
  });
  svg.addEventListener("dblclick", () => { for (const one of axes) zoom(one, [0, 1], [0, 1]); });
}

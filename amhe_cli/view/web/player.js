// The page: time, clips, layers; and in a live page the frames that arrive.
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const LONG = 3;  // seconds in which a clip plays
const LEFT_OVER = "what is left, worst first", WORST = 6;  // a channel of residuals, and how many columns it shows
const RAMP = [[0.17, 0.42, 0.69], [0.22, 0.7, 0.67], [0.93, 0.79, 0.29], [0.87, 0.29, 0.16]];
// Colours of the ghosts, by their names in style.css; any other one is that of what was identified.
const GHOSTS = { before: "before", predicted: "before", yours: "violet" };

class Player {
  constructor(data) {
    this.data = data; this.now = 0; this.speed = null; this.playing = false; this.take = null; this.row = 0;
    this.decode();
    this.shown = new Set(["measured", ...data.candidates]);
    this.plots = new Plots($("panels"), { seek: (time) => this.seek(time) });
    const failed = (text) => { $("failure").hidden = !text; $("failure").textContent = text; };
    try { this.stage = Object.assign(new Stage($("scene"), data), { changed: () => this.dirty = true, failed }); } catch (error) { failed(error.message); }
    for (const note of data.notes) $("notes").append(made("li", { textContent: note }));
    this.palette(); this.layers(); this.controls(); this.list(); this.table(); this.channels();
    if (!this.linked() && this.takes.length && !this.recording.curves.size) this.choose(this.takes[0]); else this.fit();
    addEventListener("hashchange", () => this.linked());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.palette(); this.redraw(); });
    new ResizeObserver(() => this.redraw()).observe(document.body);
    this.redraw(); requestAnimationFrame((stamp) => this.frame(stamp));
    if (data.live) this.live = new Live(this);
  }
  get recording() { return this.recordings[this.row]; }
  get end() { return this.recording.track.duration; }
  decode() {
    const { data } = this, count = data.bodies.length, width = data.columns.length;
    const track = this.unpack = (one) => one && Object.assign(new Track(one.step, count, width, unpacked(one.poses, data.ranges.poses), unpacked(one.values, data.ranges.values)),
      one.forces ? { forces: unpacked(one.forces, data.ranges.forces), touching: one.touching } : {});
    this.decoded = (take) => ({ ...take, tracks: take.tracks.map(track) });
    this.recordings = data.recordings.map((one) => ({ ...one, track: track(one.track), ghosts: data.candidates.map(() => track({ ...one.track, poses: "", values: "" })), takes: [], drawn: new Map(), curves: new Map(one.curves.map((curve) => [curve.name, curveOf(curve)])) }));
    this.takes = data.takes.map(this.decoded);
    for (const take of this.takes) this.recordings[take.recording].takes.push(take);
    for (const one of this.recordings) one.takes.sort((a, b) => a.start - b.start);
  }
  palette() {
    this.solid = { sky: rgb("sky"), ground: rgb("ground"), grid: rgb("grid"), dark: isDark() };
    this.tints = this.data.candidates.map((name) => rgb(ghost(name)));
    this.yours = rgb(ghost("yours"));
    this.colors = { gap: css(rgb("gap")), event: css(rgb("amber")) };
  }
  layers() {
    const box = $("layers");
    for (const [i, name] of ["measured", ...this.data.candidates].entries()) {
      const check = made("input", { type: "checkbox", checked: true });
      check.addEventListener("change", () => { check.checked ? this.shown.add(name) : this.shown.delete(name); this.redraw(); });
      const dot = made("i"); dot.style.background = ink(i ? ghost(name) : "measured");
      box.append(made("label", {}, check, dot, name));
    }
    this.newtons = made("span", { title: "An arrow as long as this line, where the camera looks" });
    for (const [id, text] of [["forces", made("span", {}, "contact forces ", this.newtons)], ["traces", "sampled plans"]]) {
      const check = made("input", { type: "checkbox", checked: true, id });
      check.addEventListener("change", () => this.dirty = true);
      box.append(made("label", { hidden: true }, check, text));
    }
    if (!this.data.candidates.length) return;
    const check = made("input", { type: "checkbox", id: "distance" });
    check.addEventListener("change", () => { this.far = check.checked; $("scale").hidden = !this.far; this.dirty = true; });
    box.append(made("label", { title: "Colour each body of a ghost by its distance from where it was measured" }, check, "colour by distance"));
  }
  controls() {
    $("speed").append(made("option", { value: "", textContent: `clip in ${LONG} s`, selected: true }));
    for (const speed of SPEEDS) $("speed").append(made("option", { value: speed, textContent: `${speed}×` }));
    $("speed").addEventListener("change", () => this.speed = Number($("speed").value) || null);
    if (this.data.report) $("report").append(made("a", { href: this.data.report, textContent: "report" }));
    $("play").addEventListener("click", () => this.play(!this.playing));
    $("back").addEventListener("click", () => this.step(-1)); $("forth").addEventListener("click", () => this.step(1));
    $("next").addEventListener("click", () => this.next());
    $("whole").addEventListener("click", () => { this.choose(null); });
    $("time").addEventListener("input", () => this.seek(Number($("time").value)));
    this.recordings.forEach((one, i) => $("recording").append(made("option", { value: i, textContent: one.name })));
    $("which").hidden = this.recordings.length < 2;
    $("recording").addEventListener("change", () => { this.row = Number($("recording").value); this.now = 0; this.channels(); this.choose(null); });
    document.addEventListener("keydown", (event) => {
      if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.key !== "n") return;
      const act = { " ": () => this.play(!this.playing), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1), n: () => this.next() }[event.key];
      if (act) { event.preventDefault(); act(); }
    });
  }
  list() {
    const { candidates } = this.data, box = $("list");
    $("clips").hidden = !this.takes.length; box.replaceChildren();
    $("clipkey").textContent = this.takes.length ? `cost: ${candidates.join(" → ")}${this.takes.some((take) => take.held) ? "; what was held out comes first" : ""}` : "";
    const largest = Math.max(...this.takes.flatMap((take) => take.costs.filter((cost) => cost !== null)), 1e-9);
    this.takes.forEach((take, i) => {
      const label = `${take.start.toFixed(2)}–${take.stop.toFixed(2)} s`, costs = take.costs.map((cost) => cost === null ? "diverged" : brief(cost)).join(" → ");
      const bar = made("b"); for (const cost of take.costs) { const part = made("i"); part.style.width = `${100 * Math.min(1, (cost ?? largest) / largest)}%`; bar.append(part); }
      const badge = [take.held ? "held out" : "", this.recordings.length > 1 ? this.recordings[take.recording].name : ""].filter(Boolean).join(", ");
      take.line = made("div", { className: "clip", id: `clip${i}` }, made("span", {}, label, badge ? made("em", { textContent: badge }) : ""), made("span", { textContent: costs }), bar);
      take.line.setAttribute("role", "option"); take.line.setAttribute("aria-selected", take === this.take);
      take.line.addEventListener("click", () => this.choose(take)); box.append(take.line);
    });
    if (!this.listening) box.addEventListener("keydown", (event) => {
      const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (by) { event.preventDefault(); event.stopPropagation(); this.choose(this.takes[Math.min(Math.max(this.takes.indexOf(this.take) + by, 0), this.takes.length - 1)]); }
    });
    this.listening = true;
  }
  // Each parameter: its values, its verdict, and where the page is served a slider that asks for another ghost.
  table() {
    const rows = this.data.parameters, known = rows.some((row) => row.estimate !== undefined), { asks } = this.data;
    $("parameters").hidden = !rows.length;
    const head = made("tr", {}, ...["parameter", this.data.candidates[0], ...(known ? [this.data.candidates.includes("at that time") ? "at the end" : "after"] : [])].map((text) => made("th", { textContent: text, scope: "col" })));
    this.sliders = new Map();
    const body = rows.flatMap((row) => {
      if (row.hidden) { this.sliders.set(row.name, () => row.estimate ?? row.first); return []; }  // others stand for it
      const about = made("small", {}, row.unit), chip = row.verdict ? [made("span", { className: `verdict ${row.verdict}`, textContent: row.verdict })] : [];
      const name = row.name.split(/(?<=[_.])/).flatMap((part) => [part, made("wbr")]);
      const cells = [made("td", {}, ...name, about, ...chip), made("td", { textContent: brief(row.first) })];
      if (known) cells.push(row.estimate === undefined ? made("td") : made("td", { title: "estimate and 90 % interval" }, brief(row.estimate), made("small", { textContent: `${brief(row.lower)} to ${brief(row.upper)}` })));
      if (!asks || row.low === undefined) return [made("tr", {}, ...cells)];
      const start = row.estimate ?? row.first, low = Math.min(row.low, start), high = Math.max(row.high, start), log = row.log && low > 0;
      const value = (share) => log ? low * (high / low) ** share : low + share * (high - low);
      const slider = made("input", { type: "range", min: 0, max: 1, step: "any", title: "Drag: the clip is predicted again" }), told = made("output");
      slider.setAttribute("aria-label", `Try another ${row.name}`); slider.value = log ? Math.log(start / low) / Math.log(high / low) : (start - low) / (high - low || 1);
      this.sliders.set(row.name, () => slider.dataset.moved ? value(Number(slider.value)) : start);
      slider.addEventListener("input", () => { slider.dataset.moved = "yes"; told.textContent = brief(value(Number(slider.value))); this.try(); });
      return [made("tr", {}, ...cells), made("tr", { className: "slide" }, made("td", { colSpan: cells.length }, slider, told))];
    });
    $("parameters").querySelector("table").replaceChildren(made("thead", {}, head), made("tbody", {}, ...body));
  }
  // Asks for a ghost under the sliders' values, one at a time; the newest values count.
  async try() {
    const own = this.takes.indexOf(this.take), moved = [...document.querySelectorAll(".slide input")].some((one) => one.dataset.moved);
    if (!this.data.asks || own < 0 || !moved) return;
    if (this.asked) { this.again = true; return; }
    this.asked = true;
    const values = [...this.sliders].map(([name, value]) => [name, value()]);
    try {
      const answer = await fetch(`ask?${new URLSearchParams([["take", own], ...values])}`), found = answer.ok ? await answer.json() : null;
      if (found) this.takes[own].yours = { ...found, track: this.unpack(found.track) };
      $("tried").textContent = found ? `yours: cost ${found.cost === null ? "diverged" : brief(found.cost)} in this clip, after ${brief(this.takes[own].costs.at(-1) ?? NaN)}` : "The page is no longer served: start amhe view again.";
    } catch { $("tried").textContent = "The page is no longer served: start amhe view again."; }
    $("tried").hidden = false; this.asked = false; this.redraw();
    if (this.again) { this.again = false; this.try(); }
  }
  // What the plots can show: each channel of the log, and each group of other numbers.
  channels() {
    const pick = $("channel"), before = pick.value, groups = [...new Set([...this.recording.curves.values()].map((one) => one.group))];
    pick.replaceChildren(...[...groups, ...new Set(this.data.columns.map((column) => column.channel)), ...(this.takes.length && this.data.columns.some((column) => column.noise) ? [LEFT_OVER] : [])].map((name) => made("option", { value: name, textContent: name })));
    if (before) pick.value = before;
    pick.onchange = () => { this.panels(); this.redraw(); };
    $("plots").hidden = !pick.options.length;
    this.panels();
  }
  panels() {
    const name = $("channel").value;
    const own = [...this.recording.curves.values()].filter((one) => one.group === name).map((one) => ({ title: one.name, unit: one.unit, lines: () => [{ ...one, name: "value", x: one.times, y: one.values, color: "after" }] }));
    const every = this.data.columns.map((column, k) => ({ ...column, k })), columns = every.filter((column) => column.channel === name);
    if (name === LEFT_OVER) {
      const worst = every.filter((column) => column.noise).map((column) => ({ ...column, left: this.left(column) })).sort((a, b) => b.left - a.left).slice(0, WORST);
      return this.plots.show(worst.map((column) => ({ title: `${column.channel} ${column.name}`, unit: "\u00D7 noise", height: 110, marks: [{ at: [-1, 1], axis: "y", name: "declared noise, one sd", color: "given" }], lines: (from, to) => this.lines(column.k, from, to, column.noise) })));
    }
    this.plots.show(own.length ? own : columns.map((column) => ({ title: column.name === name ? name : column.name, unit: column.unit === "rad" ? "°" : column.unit, height: 130, lines: (from, to) => this.lines(column.k, from, to) })));
  }
  // How far the best ghost misses a column over all clips, rms in units of its noise.
  left({ k, noise }) {
    let sum = 0, count = 0;
    for (const { tracks } of this.takes) for (let i = k, best = tracks.at(-1); best && i < best.values.length; i += best.width) {
      const away = (tracks[0].values[i] - best.values[i]) / noise;
      if (Number.isFinite(away)) { sum += away * away; count++; }
    }
    return Math.sqrt(sum / (count || 1));
  }
  // Curves of column k in degrees where it is an angle: what was measured, and each ghost over its clips; given its
  // noise, what each ghost leaves of the measured one in units of that.
  lines(k, from, to, noise = 0) {
    const lines = [], inside = this.recording.takes.filter((take) => take.stop >= from && take.start <= to && (!this.take || take === this.take));
    const factor = this.data.columns[k].unit === "rad" ? 180 / Math.PI : 1;
    const curve = (parts, more) => {
      const x = [], y = [];
      for (const [track, start, measured] of parts) {
        if (x.length) { x.push(start); y.push(NaN); }
        for (let i = 0; i < track.count; i++) { x.push(start + i * track.step); const value = track.values[i * track.width + k]; y.push(noise ? (measured.values[i * track.width + k] - value) / noise : factor * value); }
      }
      lines.push({ x, y, ...more });
    };
    this.data.candidates.forEach((name, i) => {
      const parts = inside.filter((take) => take.tracks[i + 1]).map((take) => [take.tracks[i + 1], take.start, take.tracks[0]]);
      if (this.shown.has(name)) curve(parts, { name, color: ghost(name), shape: i === 0 && this.data.candidates.length > 1 ? "dashed" : "line", leads: false });
    });
    if (this.take?.yours?.track) curve([[this.take.yours.track, this.take.start, this.take.tracks[0]]], { name: "yours", color: ghost("yours"), leads: false });
    if (this.shown.has("measured") && !noise) curve([this.take ? [this.take.tracks[0], this.take.start] : [this.recording.track, 0]], { name: "measured", color: "measured", shape: "dots" });
    return lines;
  }
  takeAt(time) {
    if (this.take) return this.take;
    return this.recording.takes.findLast((take) => take.start <= time && time <= take.stop) || null;
  }
  choose(take) {
    this.take = take;
    for (const one of this.takes) if (one.line) one.line.setAttribute("aria-selected", one === take);
    $("whole").setAttribute("aria-pressed", !take);
    if (take) { this.row = take.recording; $("recording").value = this.row; this.now = this.playing ? take.start : take.start + 0.7 * (take.stop - take.start); $("list").setAttribute("aria-activedescendant", take.line.id); take.line.scrollIntoView({ block: "nearest" }); }
    this.try(); this.fit(); this.redraw();
  }
  // A clip and a time that the page's address names, as in #clip=3&t=12.1; clips count from 1.
  linked() {
    const asked = new URLSearchParams(location.hash.slice(1)), take = this.takes[Number(asked.get("clip")) - 1], time = Number(asked.get("t") ?? NaN);
    if (take) this.choose(take);
    if (Number.isFinite(time)) { this.seek(time); this.redraw(); }
    return Boolean(take) || Number.isFinite(time);
  }
  // Moves the camera so far away that everything that moves is in the picture.
  fit() {
    if (!this.stage) return;
    const track = this.take ? this.take.tracks[0] : this.recording.track;
    if (!track.count) return;
    const { take, stage } = this, [from, to] = this.span(), instants = Array.from({ length: 15 }, (_, k) => from + k / 14 * (to - from));
    const seen = (tracks, start) => stage.distance(instants.flatMap((time) => tracks.map((one) => [one.at(time - start), this.middle(take, track, time)])));
    const own = seen([track], take?.start ?? 0), ghosts = take?.tracks.slice(1).filter((one) => one) ?? [];
    stage.camera.away = ghosts.length ? Math.min(Math.max(own, seen(ghosts, take.start)), 2 * own) : own;  // what runs away may leave
    if (this.data.live) stage.camera.away *= 1.5;  // its motion is still to come
    stage.camera.moved = [0, 0, 0];
  }
  seek(time) {
    const [from, to] = this.span();
    this.now = Math.min(Math.max(time, from), to); this.dirty = true; this.following = this.now >= to - 1e-6;
  }
  span() { return this.take ? [this.take.start, this.take.stop] : [0, this.end]; }
  step(by) { this.play(false); this.seek(this.now + by * (this.take ? this.take.tracks[0].step : this.recording.track.step)); }
  play(on) {
    const [from, to] = this.span();
    if (on && this.now >= to - 1e-6) this.now = from;
    this.playing = on; this.dirty = true;
    $("play").textContent = on ? "\u23F8\uFE0E" : "\u25B6\uFE0E"; $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  }
  // The next jump of an estimate where all of the log is shown, else the next clip.
  next() {
    const { events } = this.recording;
    if (!this.take && events.length) return this.seek(events.find((event) => event > this.now + 1e-6) ?? events[0]);
    if (this.takes.length) this.choose(this.takes[(this.takes.indexOf(this.take) + 1) % this.takes.length]);
  }
  frame(stamp) {
    const past = Math.min(0.1, (stamp - (this.stamp ?? stamp)) / 1000), [from, to] = this.span();
    this.stamp = stamp;
    if (this.playing) {
      this.now += past * (this.speed ?? (this.take ? (to - from) / LONG : 1)); this.dirty = true;
      if (this.now > to) this.now = this.take ? from : to;
      if (this.now >= to && !this.take && !this.data.live) this.play(false);
    }
    if (this.stale) { this.stale = false; this.redraw(); }
    if (this.dirty) this.paint();
    requestAnimationFrame((next) => this.frame(next));
  }
  redraw() {
    const [from, to] = this.span();
    $("next").hidden = !this.takes.length && !this.recording.events.length;
    $("next").textContent = !this.take && this.recording.events.length ? "next jump" : "next clip";
    this.plots.draw([this.data.live && !this.take ? Math.max(from, to - 30) : from, to]); this.marks(); this.paint();
  }
  marks() {
    const canvas = $("marks"), ratio = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    const paper = canvas.getContext("2d"), [from, to] = this.span(), x = (time) => width * (time - from) / (to - from || 1);
    paper.scale(ratio, ratio);
    const largest = Math.max(...this.takes.map((take) => take.costs.at(-1) ?? 0), 1e-9);
    for (const take of this.take ? [] : this.recording.takes) {
      paper.fillStyle = `rgb(${mixed((take.costs.at(-1) ?? largest) / largest).map((c) => Math.round(255 * c))})`;
      paper.globalAlpha = 0.75; paper.fillRect(x(take.start), height - 8, Math.max(x(take.stop) - x(take.start) - 1, 1), 8); paper.globalAlpha = 1;
    }
    paper.fillStyle = this.colors.gap;
    for (const [a, b] of this.recording.gaps) paper.fillRect(x(a), 0, Math.max(x(b) - x(a), 1), height);
    paper.fillStyle = this.colors.event;
    for (const event of this.recording.events) paper.fillRect(x(event), 0, 2, height);
  }
  paint() {
    this.dirty = false;
    const [from, to] = this.span(), take = this.takeAt(this.now), bar = $("time"), { track, ghosts, gaps } = this.recording;
    bar.min = from; bar.max = to; bar.value = this.now; bar.setAttribute("aria-valuetext", `${this.now.toFixed(2)} seconds`);
    $("clock").textContent = `${this.now.toFixed(2)} / ${to.toFixed(2)} s`;
    this.plots.cursor(this.now);
    if (!this.stage || !track.count) return;
    const measured = take ? take.tracks[0].at(this.now - take.start) : track.at(this.now);
    const predicted = this.data.candidates.map((_, i) => take ? take.tracks[i + 1]?.at(this.now - take.start) : ghosts[i]?.count ? ghosts[i].at(this.now) : null);
    const home = gaps.some(([a, b]) => a <= this.now && this.now < b), layers = [];
    if (this.far) this.scale();
    predicted.forEach((poses, i) => {  // the best one covers the others
      if (poses && this.shown.has(this.data.candidates[i])) layers.unshift({ poses, tint: this.tints[i], opacity: this.far ? 0.8 : 0.45, tints: this.far ? this.distances(measured, poses).map((d) => mixed(d / this.most)) : null });
    });
    if (take?.yours?.track) layers.unshift({ poses: take.yours.track.at(this.now - take.start), tint: this.yours, opacity: 0.6 });
    if (this.shown.has("measured")) layers[this.far ? "push" : "unshift"]({ poses: measured, opacity: 1, home });
    this.stage.draw(layers, this.middle(take, track, this.now), this.solid, { ...this.drawn(take), weight: this.data.weight });
  }
  // Forces and traces of the present time: those of the best ghost, or those that came with a live frame.
  drawn(take) {
    const { step } = this.recording.track, best = take?.tracks.at(-1);
    let found = {};
    if (best?.forces) { const wide = 6 * best.touching, frame = Math.round((this.now - take.start) / best.step); found = { forces: best.forces.subarray(frame * wide, (frame + 1) * wide) }; }
    else for (let i = 0; i < 5 && !found.forces && !found.traces; i++) found = this.recording.drawn.get(Math.round(this.now / step) - i) ?? {};
    for (const id of ["forces", "traces"]) if (found[id]) { $(id).parentElement.hidden = false; if (!$(id).checked) found = { ...found, [id]: null }; }
    if (found.forces) this.rule();
    return found;
  }
  // The line that is as long as an arrow of a round force, where the camera looks.
  rule() {
    const { weight } = this.data, power = 10 ** Math.floor(Math.log10(weight)), round = power * [5, 2, 1].find((k) => k * power <= weight);
    const long = this.stage.reach * this.stage.canvas.clientHeight * round / weight, line = made("i", { className: "rule" });
    line.style.width = `${long.toFixed(0)}px`; this.newtons.replaceChildren(line, ` ${brief(round)} N`);
  }
  // The place that the camera follows: the bodies' mean over a second or so, which moves smoothly.
  middle(take, track, now) {
    let sum = [0, 0, 0];
    const count = 7;
    for (let i = 0; i < count; i++) {
      const time = now + (i / (count - 1) - 0.5) * 1.6;
      const poses = take && this.take ? take.tracks[0].at(Math.min(Math.max(time, take.start), take.stop) - take.start) : track.at(time);
      sum = add(sum, this.stage.middle(poses));
    }
    return times(sum, 1 / count);
  }
  distances(a, b) { return Array.from({ length: this.data.bodies.length }, (_, i) => Math.hypot(a[7 * i] - b[7 * i], a[7 * i + 1] - b[7 * i + 1], a[7 * i + 2] - b[7 * i + 2])); }
  // One scale for all clips of a log: the largest distance of a ghost from what was measured.
  scale() {
    const { recording } = this;
    if (!recording.most) {
      recording.most = 1e-3;
      for (const take of recording.takes) for (const track of take.tracks.slice(1)) if (track) for (let i = 0; i <= 10; i++) {
        const time = i / 10 * track.duration; recording.most = Math.max(recording.most, ...this.distances(take.tracks[0].at(time), track.at(time)));
      }
    }
    this.most = recording.most;
    $("most").textContent = this.most < 0.1 ? `${brief(1000 * this.most)} mm` : `${brief(this.most)} m`;
  }
}

const ghost = (name) => GHOSTS[name] ?? "after";
function curveOf(curve) {
  const numbers = (text) => text === null ? null : Array.from(floats(text));
  return { ...curve, times: numbers(curve.times), values: numbers(curve.values), lower: numbers(curve.lower), upper: numbers(curve.upper) };
}
function mixed(share) {
  const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1), i = Math.min(Math.floor(place), RAMP.length - 2);
  return RAMP[i].map((c, k) => c + (place - i) * (RAMP[i + 1][k] - c));
}
const player = new Player(JSON.parse($("data").textContent));

// Figures: the numbers under the pointer; drag to zoom in, double click to see all again.
for (const svg of document.querySelectorAll("svg[data-axes]")) {
  const axes = JSON.parse(svg.dataset.axes), whole = svg.getAttribute("viewBox"), tip = document.createElement("div");
  tip.className = "tip"; tip.hidden = true; document.body.append(tip);
  let from = null, frame = null;
  const place = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  const value = (share, [low, high, log]) => log ? low * (high / low) ** share : low + share * (high - low);
  const text = (v, [low, high]) => String(Number(v.toPrecision(Math.max(3, Math.ceil(Math.log10(Math.abs(v) / Math.abs(high - low) || 1)) + 3))));
  svg.addEventListener("pointermove", (event) => {
    const { x, y } = place(event), one = axes.find(({ box: [l, t, r, b] }) => l <= x && x <= r && t <= y && y <= b);
    tip.hidden = !one;
    if (one) {
      const [l, t, r, b] = one.box;
      tip.textContent = `${text(value((x - l) / (r - l), one.x), one.x)}, ${text(value((b - y) / (b - t), one.y), one.y)}`;
      tip.style.left = `${event.clientX + 12}px`; tip.style.top = `${event.clientY + 12}px`;
    }
    if (frame) for (const [name, v] of Object.entries({ x: Math.min(x, from.x), y: Math.min(y, from.y), width: Math.abs(x - from.x), height: Math.abs(y - from.y) })) frame.setAttribute(name, v);
  });
  svg.addEventListener("pointerleave", () => tip.hidden = true);
  svg.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch" || event.button) return;
    event.preventDefault(); from = place(event); svg.setPointerCapture(event.pointerId);
    frame = svg.appendChild(document.createElementNS(svg.namespaceURI, "rect"));
    frame.setAttribute("class", "frame");
  });
  svg.addEventListener("pointerup", (event) => {
    if (!frame) return;
    const { x, y } = place(event), wide = Math.abs(x - from.x), high = Math.abs(y - from.y);
    frame.remove(); frame = null;
    if (wide > 8 && high > 8) svg.setAttribute("viewBox", `${Math.min(x, from.x)} ${Math.min(y, from.y)} ${wide} ${high}`);
  });
  svg.addEventListener("dblclick", () => svg.setAttribute("viewBox", whole));
}

// What a reader would stumble over on the page, one line each; frames in it are looked into.
// An expression whose value is a list of texts.
(() => {
  const LEAST = 4.5;  // contrast of text, as of WCAG's level AA
  const found = new Set();
  const say = (kind, text) => found.add(`${kind}: ${text.trim().replace(/\s+/g, " ").slice(0, 70)}`);
  const pencil = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const read = new Map();
  const colour = (text, filter = "none") => {  // any colour of CSS as red, green, blue (0 to 255) and opacity
    const key = text + filter;
    if (!read.has(key)) {
      pencil.clearRect(0, 0, 1, 1); pencil.filter = filter; pencil.fillStyle = text; pencil.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = pencil.getImageData(0, 0, 1, 1).data; read.set(key, [r, g, b, a / 255]);
    }
    return read.get(key);
  };
  const over = ([r, g, b, a], below) => [r, g, b].map((v, i) => a * v + (1 - a) * below[i]);
  const light = (rgb) => rgb.map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4).reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const contrast = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
  const parents = function* (one) { for (let e = one; e; e = e.parentElement ?? e.ownerDocument.defaultView.frameElement) yield e; };
  const behind = (one) => {  // the colour on which an element's text stands
    const layers = [];
    for (const e of parents(one)) { const c = colour(getComputedStyle(e).backgroundColor); if (c[3]) layers.push(c); if (c[3] === 1) break; }
    return layers.reverse().reduce((below, c) => over(c, below), [255, 255, 255]);
  };
  const clip = (one, name) => ["auto", "scroll", "hidden", "clip"].includes(getComputedStyle(one)[name]);

  function look(page) {
    const { documentElement: root } = page, width = page.defaultView.innerWidth;
    if (root.scrollWidth > width) say("wider than the window", `${root.scrollWidth} of ${width} px`);
    const texts = [], walk = page.createTreeWalker(page.body, NodeFilter.SHOW_TEXT);
    for (let node; (node = walk.nextNode());) {
      const text = node.textContent.trim(), one = node.parentElement;
      if (!text || ["SCRIPT", "STYLE", "NOSCRIPT", "OPTION", "TITLE"].includes(one.tagName) || !one.checkVisibility({ visibilityProperty: true })) continue;
      const range = page.createRange(); range.selectNodeContents(node);
      if (one.namespaceURI.endsWith("MathML")) continue;  // accents stand on their letters
      const boxes = [...range.getClientRects()].filter((box) => box.width > 1 && box.height > 1);
      if (!boxes.length) continue;
      const style = getComputedStyle(one), svg = one.closest("svg"), below = behind(one);
      const ink = svg ? colour(style.fill, getComputedStyle(svg).filter) : colour(style.color);
      let opacity = ink[3]; for (const e of parents(one)) opacity *= Number(getComputedStyle(e).opacity);
      if (opacity < 0.02 || boxes.every((box) => box.right < 0)) continue;  // a drawer that is shut
      const strength = contrast(over([...ink.slice(0, 3), opacity], below), below);
      if (strength < LEAST) say(`contrast ${strength.toFixed(1)}`, text);
      let ends = [-Infinity, Infinity], heights = [-Infinity, Infinity], cut = false, stuck = false;  // where parents that scroll or clip let it be seen
      for (const e of parents(one)) {
        if (e.ownerDocument !== page) break;
        if (["sticky", "fixed"].includes(getComputedStyle(e).position)) stuck = true;
        if (e.tagName === "svg" || e === page.body || e === root) continue;
        const box = e.getBoundingClientRect();
        if (clip(e, "overflowY")) heights = [Math.max(heights[0], box.top), Math.min(heights[1], box.bottom)];
        if (clip(e, "overflowX")) {
          ends = [Math.max(ends[0], box.left), Math.min(ends[1], box.right)];
          if (!["auto", "scroll"].includes(getComputedStyle(e).overflowX) && e.scrollWidth > e.clientWidth + 1 && e.clientWidth) cut = true;
        }
      }
      if (cut && !one.closest("[title]")) say("cut off", text);
      const [left, right] = [Math.min(...boxes.map((b) => b.left)), Math.max(...boxes.map((b) => b.right))];
      if (Number.isFinite(ends[1]) ? false : right > width + 1 || left < -1) say("outside the window", text);
      if (svg) { const frame = svg.getBoundingClientRect(); if (left < frame.left - 1 || right > frame.right + 1) say("outside its figure", text); }
      if (!stuck) for (const box of boxes) if (box.right > ends[0] && box.left < ends[1] && box.bottom > heights[0] && box.top < heights[1]) texts.push({ text, box: { left: Math.max(box.left, ends[0]), right: Math.min(box.right, ends[1]), top: Math.max(box.top, heights[0]), bottom: Math.min(box.bottom, heights[1]) }, one });
    }
    // texts that stand on each other: their lines' boxes are higher than their letters
    texts.sort((a, b) => a.box.top - b.box.top);
    texts.forEach((a, i) => {
      for (let k = i + 1; k < texts.length && texts[k].box.top < a.box.bottom; k++) {
        const b = texts[k], wide = Math.min(a.box.right, b.box.right) - Math.max(a.box.left, b.box.left), high = Math.min(a.box.bottom, b.box.bottom) - b.box.top;
        if (wide > 1 && high > 0.35 * Math.min(a.box.bottom - a.box.top, b.box.bottom - b.box.top)) say("on each other", `${a.text.slice(0, 30)} | ${b.text.slice(0, 30)}`);
      }
    });
    const shown = (one) => one.checkVisibility({ visibilityProperty: true });
    for (const one of page.querySelectorAll("figure")) if (shown(one) && !one.querySelector("svg, canvas, img, picture")) say("an empty figure", one.className);
    for (const one of page.querySelectorAll(".panel")) if (shown(one) && ![...one.querySelectorAll("path")].some((path) => path.getAttribute("d")?.length > 1)) say("an empty panel", one.textContent);
    for (const one of page.querySelectorAll(".wide")) if (shown(one) && one.scrollWidth > one.clientWidth + 1) say("a table that scrolls", one.textContent);
    for (const one of page.querySelectorAll("img")) if (shown(one) && !one.naturalWidth) say("an empty picture", one.alt);
    for (const one of page.querySelectorAll("canvas")) {
      if (!shown(one) || !one.clientWidth) continue;
      const gl = one.id === "scene" && one.getContext("webgl2"), paper = gl ? null : one.getContext("2d");
      let pixels = null;
      if (gl) { pixels = new Uint8Array(4 * one.width * one.height); gl.readPixels(0, 0, one.width, one.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels); }
      else if (paper && one.id !== "marks") pixels = paper.getImageData(0, 0, one.width, one.height).data;
      if (pixels && new Set(new Uint32Array(pixels.buffer.slice(0))).size < 20) say("an empty scene", one.id || one.getAttribute("aria-label") || "");
    }
    for (const frame of page.querySelectorAll("iframe")) look(frame.contentDocument);
  }
  look(document);
  return [...found];
})()

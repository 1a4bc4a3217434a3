// The scene: lit triangles in WebGL, translucent ghosts, shadows on the floor, a camera that follows.
const ARROW = 0.25;  // length of an arrow of the weight, as a share of the distance from which one looks
const LIGHT = unit([-0.35, 0.45, 1.0]);
// How much further away a layer is drawn where an earlier one is seen, in distances from the eye: where their faces
// nearly coincide there are no patches of both.
const BACK = 0.06;
const LOST = "The browser has lost the picture's graphics context. Reload the page if the picture does not come back; the plots are complete.";
const VERTEX = `#version 300 es
precision highp float;
in vec3 place; in vec3 normal; uniform mat4 model, view; uniform vec3 eye; uniform float back; out vec3 world, facing;
void main() {
  world = (model * vec4(place, 1.0)).xyz; facing = mat3(model) * normal;
  gl_Position = view * vec4(mix(world, eye, -back), 1.0);  // further away on the line of sight, in the same place of the picture
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 world, facing; out vec4 shown;
uniform vec4 color; uniform vec3 eye, light, grid, sky, middle; uniform int kind; uniform float reach;
void main() {
  if (kind == 2) { shown = color; return; }
  if (kind == 1) {
    vec2 cell = world.xy * 4.0, fine = abs(fract(cell - 0.5) - 0.5) / fwidth(cell);
    vec2 metre = abs(fract(world.xy - 0.5) - 0.5) / fwidth(world.xy);
    float line = max(0.35 * (1.0 - min(min(fine.x, fine.y), 1.0)), 1.0 - min(min(metre.x, metre.y), 1.0));
    float far = smoothstep(0.35, 1.0, length(world.xy - middle.xy) / reach);
    shown = vec4(mix(mix(color.rgb, grid, line), sky, far), 1.0); return;
  }
  vec3 n = kind == 3 ? normalize(cross(dFdx(world), dFdy(world))) : normalize(facing), toward = normalize(eye - world);
  if (dot(n, toward) < 0.0) n = -n;
  float lit = 0.42 + 0.5 * max(dot(n, light), 0.0) + 0.14 * max(dot(n, toward), 0.0);
  float shine = pow(max(dot(n, normalize(light + toward)), 0.0), 40.0);
  shown = vec4(min(color.rgb * lit + 0.12 * shine, 1.0), color.a);
}`;

class Stage {
  constructor(canvas, data) {
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true, stencil: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2: the scene cannot be drawn. The plots below are complete.");
    this.canvas = canvas; this.bodies = data.bodies.length; this.unmeasured = new Set(data.unmeasured);
    this.load(data);
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); this.failed(LOST); });
    canvas.addEventListener("webglcontextrestored", () => { this.load(data); this.failed(""); this.changed(); });
    this.camera = { around: -2.2, above: 0.36, away: 2, moved: [0, 0, 0] };
    this.handle();
  }
  // What lies on the graphics card: all of it is gone with a lost context.
  load(data) {
    const gl = this.gl;
    this.program = this.compile(); this.at = {};
    for (const name of ["model", "view", "color", "eye", "light", "grid", "sky", "middle", "kind", "reach", "back"]) {
      this.at[name] = gl.getUniformLocation(this.program, name);
    }
    this.geoms = data.geoms.map((geom) => this.loaded(geom));
    const floors = this.geoms.filter((geom) => geom.floor && geom.local[10] > 0.99);
    this.ground = floors.length ? Math.max(...floors.map((geom) => geom.local[14])) : null;
    this.arrow = this.mesh(...arrow()); this.line = gl.createVertexArray(); this.points = gl.createBuffer();
    gl.bindVertexArray(this.line); gl.bindBuffer(gl.ARRAY_BUFFER, this.points);
    gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0); gl.bindVertexArray(null);
  }
  compile() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place"); gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("The scene cannot be drawn: " + gl.getProgramInfoLog(program));
    return program;
  }
  loaded(geom) {
    return { ...this.mesh(floats(geom.vertices), rows(geom.faces)), local: placed(geom.pose), body: geom.body, color: geom.color, floor: geom.floor,
      kind: geom.floor ? 1 : geom.flat ? 3 : 0 };
  }
  mesh(places, faces) {
    const gl = this.gl, normals = new Float32Array(places.length), low = [0, 0, 0], high = [0, 0, 0];
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => Array.from(places.subarray(3 * faces[f + k], 3 * faces[f + k] + 3)));
      const normal = cross(less(b, a), less(c, a));
      for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) normals[3 * faces[f + k] + i] += normal[i];
    }
    for (let v = 0; v < normals.length; v += 3) {
      const length = Math.hypot(normals[v], normals[v + 1], normals[v + 2]) || 1;
      for (let i = 0; i < 3; i++) { normals[v + i] /= length; low[i] = Math.min(low[i], places[v + i]); high[i] = Math.max(high[i], places[v + i]); }
    }
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    [places, normals].forEach((values, slot) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(slot); gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, count: faces.length, low, high };
  }
  // Corners of the boxes around all that moves.
  corners(poses) {
    return this.geoms.filter((geom) => geom.body >= 0).flatMap(({ body, local, low, high }) => {
      const at = product(placed(poses, 7 * body), local);
      return Array.from({ length: 8 }, (_, k) => {
        const place = [0, 1, 2].map((i) => (k >> i & 1 ? high : low)[i]);
        return [0, 1, 2].map((r) => at[r] * place[0] + at[4 + r] * place[1] + at[8 + r] * place[2] + at[12 + r]);
      });
    });
  }
  // Centre of all that moves.
  middle(poses) {
    const corners = this.corners(poses);
    if (!corners.length) return [0, 0, 0.3];
    return [0, 1, 2].map((i) => { const [low, high] = spread([corners.map((place) => place[i])]); return (low + high) / 2; });
  }
  // How wide the picture is over its height, and the tangent of half the angle of that.
  lens() { const wide = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1); return { wide, half: Math.tan(wide < 1 ? 0.425 : 0.3) }; }
  // From how far away all of some frames, poses and the place that the camera looks at, are in the picture.
  distance(frames) {
    const { around, above } = this.camera, { wide, half } = this.lens();
    const back = [Math.cos(around) * Math.cos(above), Math.sin(around) * Math.cos(above), Math.sin(above)];
    const right = unit(cross([0, 0, 1], back)), top = cross(back, right);
    const needs = frames.flatMap(([poses, at]) => this.corners(poses).map((corner) => {
      const place = less(corner, at); return dot(place, back) + Math.max(Math.abs(dot(place, right)) / wide, Math.abs(dot(place, top))) / half;
    }));
    return 1.15 * Math.max(spread([needs])?.[1] ?? 2, 0.02);  // a little room
  }
  handle() {
    const canvas = this.canvas, camera = this.camera, held = new Map();
    let spread = 0;
    canvas.addEventListener("pointerdown", (event) => { held.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); spread = 0; });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = held.get(event.pointerId);
      if (!before) return;
      const x = event.clientX - before.clientX, y = event.clientY - before.clientY;
      held.set(event.pointerId, event);
      if (held.size > 1) {
        const [a, b] = [...held.values()], apart = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) camera.away *= spread / apart;
        spread = apart; this.shift(x / 2, y / 2);
      } else if (event.shiftKey || event.buttons === 2) this.shift(x, y);
      else { camera.around -= x * 0.008; camera.above = Math.min(1.55, Math.max(-0.3, camera.above + y * 0.008)); }
      this.changed();
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); camera.away *= Math.exp(event.deltaY * 0.001); this.changed(); }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turn = { a: [-0.1, 0], d: [0.1, 0], w: [0, 0.1], s: [0, -0.1] }[event.key], zoom = { "+": 0.9, "-": 1.1 }[event.key];
      if (turn) { camera.around += turn[0]; camera.above = Math.min(1.55, Math.max(-0.3, camera.above + turn[1])); }
      if (zoom) camera.away *= zoom;
      if (turn || zoom) this.changed();
    });
  }
  shift(x, y) {
    const { around } = this.camera, scale = this.camera.away / this.canvas.clientHeight;
    this.camera.moved = add(this.camera.moved, [scale * (Math.sin(around) * x + 0.4 * Math.cos(around) * -y), scale * (-Math.cos(around) * x - 0.4 * Math.sin(around) * y), scale * 0.6 * y]);
  }
  // The page says what to do when the picture has changed, or has failed: a sentence, empty where it is back.
  changed() {}
  failed() {}
  // Draws layers: { poses, tint, opacity, tints } each, the one without a tint measured, and where two nearly coincide
  // the earlier one; arrows of forces, 6 numbers each, long at a weight; and lines through so many points each.
  draw(layers, middle, colors, { forces, weight, traces, points }) {
    if (this.gl.isContextLost()) return;
    const gl = this.gl, canvas = this.canvas, ratio = Math.min(window.devicePixelRatio || 1, 2), { around, above, away } = this.camera;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const at = add(middle, this.camera.moved);
    const eye = add(at, times([Math.cos(around) * Math.cos(above), Math.sin(around) * Math.cos(above), Math.sin(above)], away));
    const { wide, half } = this.lens();
    this.reach = ARROW / (2 * half);  // an arrow of the weight, as a share of the height
    const view = product(perspective(half, wide, away / 60, away * 40), looking(eye, at, [0, 0, 1]));
    gl.viewport(0, 0, width, height);
    gl.clearColor(...colors.sky, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.depthFunc(gl.LEQUAL); gl.useProgram(this.program);
    gl.uniformMatrix4fv(this.at.view, false, view);
    for (const [name, value] of Object.entries({ eye, light: LIGHT, grid: colors.grid, sky: colors.sky, middle: at })) gl.uniform3fv(this.at[name], value);
    gl.uniform1f(this.at.reach, 9 * away);
    for (const geom of this.geoms) if (geom.body < 0) this.geom(geom, geom.local, geom.floor ? [...colors.ground, 1] : geom.color, geom.kind);
    const measured = layers.find((layer) => !layer.tint);
    if (this.ground !== null && measured && eye[2] > this.ground) this.shadows(measured.poses, colors);
    gl.enable(gl.BLEND); gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    layers.forEach((layer, i) => this.layer(layer, i));
    gl.disable(gl.BLEND);
    gl.clear(gl.DEPTH_BUFFER_BIT);  // what follows is seen through bodies
    if (traces) this.lines(traces, points);
    if (forces) this.arrows(forces, ARROW * away / weight, 0.02 * away);
  }
  arrows(forces, long, thick) {
    for (let i = 0; i < forces.length; i += 6) {
      const force = Array.from(forces.subarray(i + 3, i + 6)), size = Math.hypot(...force);
      if (!(long * size > 0.5 * thick)) continue;  // too short, or none
      const along = times(force, long * Math.min(1, 25 * thick / (long * size))), ahead = unit(along);
      const side = times(unit(cross(ahead, Math.abs(ahead[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), thick), up = cross(ahead, side);
      this.geom(this.arrow, [...side, 0, ...up, 0, ...along, 0, forces[i], forces[i + 1], forces[i + 2], 1], [0.86, 0.12, 0.36, 1], 3);
    }
  }
  lines(traces, points) {
    const gl = this.gl;
    gl.bindVertexArray(this.line); gl.bindBuffer(gl.ARRAY_BUFFER, this.points); gl.bufferData(gl.ARRAY_BUFFER, traces, gl.DYNAMIC_DRAW);
    gl.uniformMatrix4fv(this.at.model, false, placed([0, 0, 0, 1, 0, 0, 0])); gl.uniform4f(this.at.color, 0.75, 0.25, 1.0, 1.0); gl.uniform1i(this.at.kind, 2);
    for (let first = 0; first < traces.length / 3; first += points) gl.drawArrays(gl.LINE_STRIP, first, points);
  }
  // The stencil has a bit for each layer, set where it was drawn: there later ones are pushed back.
  layer({ poses, tint, opacity, tints, home }, i) {
    const gl = this.gl, bodies = Array.from({ length: this.bodies }, (_, i) => placed(poses, 7 * i)), own = 1 << i;
    gl.enable(gl.STENCIL_TEST); gl.stencilMask(own); gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    for (const [where, back] of i ? [[gl.EQUAL, 0], [gl.NOTEQUAL, BACK]] : [[gl.EQUAL, 0]]) {
      gl.stencilFunc(where, own, own - 1); gl.uniform1f(this.at.back, back);
      for (const only of opacity < 1 ? ["depth", "color"] : ["color"]) {  // a ghost's own parts do not shine through
        gl.colorMask(only === "color", only === "color", only === "color", only === "color");
        for (const geom of this.geoms) {
          if (geom.body < 0) continue;
          const hue = tints ? tints[geom.body] : tint, grey = !tint && (home || this.unmeasured.has(geom.body));
          const color = hue ? hue.map((c, i) => 0.85 * c + 0.15 * geom.color[i]) : grey ? [0.55, 0.55, 0.55] : geom.color.slice(0, 3);
          this.geom(geom, product(bodies[geom.body], geom.local), [...color, opacity], geom.kind);
        }
      }
    }
    gl.stencilMask(255); gl.disable(gl.STENCIL_TEST); gl.uniform1f(this.at.back, 0);
  }
  shadows(poses, colors) {
    const gl = this.gl, flat = shadowed(LIGHT, this.ground + 0.001);
    gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.STENCIL_TEST); gl.stencilFunc(gl.EQUAL, 0, 255); gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.enable(gl.POLYGON_OFFSET_FILL); gl.polygonOffset(-1, -2); gl.depthMask(false);
    for (const geom of this.geoms) {
      if (geom.body >= 0) this.geom(geom, product(flat, product(placed(poses, 7 * geom.body), geom.local)), [0.05, 0.08, 0.12, colors.dark ? 0.45 : 0.28], 2);
    }
    gl.depthMask(true); gl.disable(gl.POLYGON_OFFSET_FILL); gl.disable(gl.STENCIL_TEST); gl.disable(gl.BLEND); gl.clear(gl.STENCIL_BUFFER_BIT);
  }
  geom(geom, model, color, kind) {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.at.model, false, model);
    gl.uniform4fv(this.at.color, color); gl.uniform1i(this.at.kind, kind);
    gl.bindVertexArray(geom.array);
    gl.drawElements(gl.TRIANGLES, geom.count, gl.UNSIGNED_SHORT, 0);
  }
}

// An arrow of length 1 along z: corners and faces of a shaft and a tip of six sides each.
function arrow() {
  const places = [0, 0, 0.7, 0, 0, 1], faces = [], thin = 0.16, wide = 0.42;
  for (let i = 0; i < 6; i++) {
    const c = Math.cos(i * Math.PI / 3), s = Math.sin(i * Math.PI / 3), at = 2 + 3 * i, next = 2 + 3 * ((i + 1) % 6);
    places.push(thin * c, thin * s, 0, thin * c, thin * s, 0.7, wide * c, wide * s, 0.7);
    faces.push(at, next, at + 1, next, next + 1, at + 1, at + 2, next + 2, 1, 0, next + 2, at + 2);
  }
  return [new Float32Array(places), new Uint16Array(faces)];
}

"use strict";
// The page of one scene: decodes it, draws it by the shaders, and lets its lamp and its camera be dragged.
(() => {
  const byId = (id) => document.getElementById(id);
  const scene = JSON.parse(byId("scene").textContent);
  const canvas = byId("picture");
  const SAMPLES = 64;                 // per pixel, at rest
  const DRAG_MS = 40;                 // for one picture while something is dragged
  const BAND_MS = 120;                // for one part of a picture at rest, so that a hand is never kept waiting
  const REST_MS = 500, REST_COARSEST = 2;  // for one sample at rest: beyond, the picture has fewer pixels
  const COARSEST = 8;                 // pixels of the screen per pixel of the picture
  const LOW = 0.03, HIGH = 0.998;     // radius of the lamp's place in the dome seen from above
  const GOLDEN = 0.61803398875;       // of a turn, between samples of the lamp
  const TURN_PER_PX = 0.007, LIGHT_PER_PX = 0.0035, ZOOM_PER_NOTCH = 1.1;
  const HIGHEST = 1.45, LOWEST = 0.06;  // elevation of the view, rad
  const home = scene.view;
  let view = { ...home }, lamp = { ...scene.lamp };
  let gl, draw, show, targets = [], textures = {}, drags = "light";
  let count = 0, row = 0, coarse = 4, restsAt = 0, pace = 0, atRest = 1, scheduled = false, sharp = null;

  // --- vectors --------------------------------------------------------------------------------------------------

  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a); return a.map((x) => x / n); };
  const onSphere = (azimuth, elevation) => [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
  const voxels = (p) => p.map((x, i) => (x - scene.origin[i]) / scene.spacing);

  function camera(height) {
    const eye = add(scene.centre, onSphere(view.azimuth, view.elevation), view.distance);
    const forward = unit(add(scene.centre, eye, -1));
    const right = unit(cross(forward, [0, 0, 1]));
    return { eye: voxels(eye), forward, right, down: cross(forward, right), focal: view.focal * height };
  }

  // --- decoding -------------------------------------------------------------------------------------------------

  async function unpacked(text) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  const halfToNumber = (h) => {
    const e = (h >> 10) & 31, m = h & 1023, s = h & 32768 ? -1 : 1;
    return e ? s * 2 ** (e - 15) * (1 + m / 1024) : s * 2 ** -14 * (m / 1024);
  };

  async function decode() {
    const [nx, ny, nz] = scene.nodes, n = nx * ny * nz;
    const planes = await unpacked(scene.distances), colours = await unpacked(scene.colours);
    const halves = new Uint16Array(n), rgba = new Uint8Array(4 * n), share = colours.length / 3;
    // The file runs through z first, a texture through x first.
    let from = 0, k = 0;
    for (let x = 0; x < nx; x++) for (let y = 0; y < ny; y++) for (let z = 0; z < nz; z++, from++) {
      const to = x + nx * (y + ny * z), h = (planes[from] << 8) | planes[n + from];
      halves[to] = h;
      if (Math.abs(halfToNumber(h)) < scene.coloured) {
        rgba.set([colours[k], colours[share + k], colours[2 * share + k], 255], 4 * to);
        k++;
      }
    }
    if (k !== share) throw new Error("the colours do not fit the shape");
    return { halves, rgba };
  }

  // --- WebGL ----------------------------------------------------------------------------------------------------

  function program(fragment) {
    const vertex = "#version 300 es\nvoid main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }";
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text.trim());
      gl.compileShader(shader);
      gl.attachShader(made, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    return { made, at: (name) => (at[name] ??= gl.getUniformLocation(made, name)) };
  }

  function volume(format, internal, type, data) {
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, internal, ...scene.nodes, 0, format, type, data);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(gl.TEXTURE_3D, side, gl.CLAMP_TO_EDGE);
    for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, size, gl.LINEAR);
    return texture;
  }

  function flat(filter) {
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, filter);
    return texture;
  }

  function makeTargets(width, height) {
    for (const { texture, frame } of targets) { gl.deleteTexture(texture); gl.deleteFramebuffer(frame); }
    targets = [0, 1].map(() => {
      const texture = flat(gl.NEAREST), frame = gl.createFramebuffer();
      gl.texImage2D(gl.TEXTURE_2D, 0, sharp.internal, width, height, 0, gl.RGBA, sharp.type, null);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      return { texture, frame, width, height };
    });
  }

  async function begin() {
    if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old to unpack the scene");
    gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser shows no WebGL 2");
    if (gl.getExtension("EXT_color_buffer_float")) sharp = { internal: gl.RGBA32F, type: gl.FLOAT, samples: SAMPLES };
    else if (gl.getExtension("EXT_color_buffer_half_float")) sharp = { internal: gl.RGBA16F, type: gl.HALF_FLOAT, samples: 16 };
    else throw new Error("this graphics card draws no floating-point pictures");
    const { halves, rgba } = await decode();
    draw = program(byId("scene-shader").textContent);
    show = program(byId("show-shader").textContent);
    textures.distances = volume(gl.RED, gl.R16F, gl.HALF_FLOAT, halves);
    textures.colours = volume(gl.RGBA, gl.SRGB8_ALPHA8, gl.UNSIGNED_BYTE, rgba);
    const ground = new Image();
    ground.src = scene.ground;
    await ground.decode();
    textures.ground = flat(gl.LINEAR);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, ground);
    gl.bindVertexArray(gl.createVertexArray());
    byId("controls").hidden = false;
    restart(false);
  }

  // --- drawing --------------------------------------------------------------------------------------------------

  function uniforms(width, height, sample) {
    const { at } = draw, c = camera(height), place = lampPlace();
    gl.useProgram(draw.made);
    gl.uniform3f(at("nodes"), ...scene.nodes);
    gl.uniform1f(at("groundHeight"), voxels([0, 0, scene.groundHeight])[2]);
    gl.uniform2f(at("groundCentre"), ...voxels([...scene.groundCentre, 0]).slice(0, 2));
    gl.uniform1f(at("groundHalf"), scene.groundHalf / scene.spacing);
    gl.uniform3f(at("groundMean"), ...scene.groundMean);
    gl.uniform3f(at("background"), ...scene.background);
    gl.uniform1f(at("fadeFrom"), scene.fade[0] / scene.spacing);
    gl.uniform1f(at("fadeTo"), scene.fade[1] / scene.spacing);
    for (const name of ["eye", "right", "down", "forward"]) gl.uniform3f(at(name), ...c[name]);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("focal"), c.focal);
    gl.uniform3f(at("lamp"), ...voxels(place));
    gl.uniform1f(at("lampRadius"), lamp.radius / scene.spacing);
    gl.uniform1f(at("strength"), lamp.strength * (lamp.distance / scene.spacing) ** 2);
    gl.uniform1f(at("ambient"), scene.ambient * lamp.strength / scene.lamp.strength);
    // Halton's points: the first sample is the middle of the pixel. At each pixel the lamp's are turned by a hash.
    const halton = (i, b) => { let f = 1, r = 0; for (; i > 0; i = Math.floor(i / b)) { f /= b; r += f * (i % b); } return r; };
    gl.uniform2f(at("jitter"), sample ? halton(sample, 2) - 0.5 : 0, sample ? halton(sample, 3) - 0.5 : 0);
    gl.uniform1f(at("turn"), sample * GOLDEN % 1);
    gl.uniform1f(at("reach"), Math.sqrt(halton(sample + 1, 2)));
    gl.uniform1f(at("share"), 1 / (sample + 1));
    const bound = { distances: [gl.TEXTURE_3D, textures.distances], colours: [gl.TEXTURE_3D, textures.colours], groundPicture: [gl.TEXTURE_2D, textures.ground], before: [gl.TEXTURE_2D, targets[1].texture] };
    Object.entries(bound).forEach(([name, [kind, texture]], i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(kind, texture);
      gl.uniform1i(at(name), i);
    });
  }

  function frame() {
    scheduled = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const full = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    if (canvas.width !== full[0] || canvas.height !== full[1]) { [canvas.width, canvas.height] = full; count = row = 0; }
    const moving = performance.now() < restsAt, slow = Math.sqrt(pace * full[0] * full[1] / REST_MS);
    if (!count && !row) atRest = clamp(Math.ceil(2 * slow) / 2, 1, REST_COARSEST);
    const factor = moving ? coarse : atRest;
    const width = Math.ceil(full[0] / factor), height = Math.ceil(full[1] / factor);
    if (!targets.length || targets[0].width !== width || targets[0].height !== height) { makeTargets(width, height); count = row = 0; }
    // The time that a picture takes is what reading one pixel of it waits for.
    const rows = moving || !pace ? height : clamp(Math.floor(BAND_MS / (pace * width)), 16, height);
    const begun = performance.now(), first = row, last = Math.min(height, first + rows);
    uniforms(width, height, count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, targets[0].frame);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, first, width, last - first);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
    gl.readPixels(0, first, 1, 1, gl.RGBA, gl.FLOAT, new Float32Array(4));
    const spent = performance.now() - begun;
    pace = spent / (width * (last - first));
    if (moving) coarse = clamp(Math.round(coarse * Math.sqrt(spent / DRAG_MS)), 1, COARSEST);
    row = last;
    if (last >= height) {
      targets.reverse();
      row = 0;
      count++;
      present(width / full[0], height / full[1], full);
    }
    byId("still").hidden = byId("still").hidden || count > 0;
    if (moving || count < sharp.samples) schedule();
  }

  function present(sx, sy, full) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...full);
    gl.useProgram(show.made);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, targets[1].texture);
    gl.uniform1i(show.at("picture"), 0);
    gl.uniform2f(show.at("scale"), sx, sy);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  function schedule() { if (!scheduled) { scheduled = true; requestAnimationFrame(frame); } }

  function restart(moves = true) {
    count = row = 0;
    if (moves) restsAt = performance.now() + 180;
    sayWhere();
    schedule();
  }

  // --- the lamp -------------------------------------------------------------------------------------------------

  // Its place is a point of a dome over the object, told from above: u towards the right of the view, v away from it.
  const lampPlace = () => add(scene.centre, onSphere(lamp.azimuth, lamp.elevation), lamp.distance);
  const lampFromAbove = () => {
    const r = Math.cos(lamp.elevation), a = lamp.azimuth - view.azimuth;
    return [r * Math.sin(a), -r * Math.cos(a)];
  };

  function putLamp(u, v) {
    const r = clamp(Math.hypot(u, v), LOW, HIGH), a = Math.atan2(u, -v);
    lamp.azimuth = view.azimuth + a;
    lamp.elevation = Math.acos(r);
    restart();
  }

  function sayWhere() {
    const [u, v] = lampFromAbove();
    byId("lamp").setAttribute("cx", 46 * u);
    byId("lamp").setAttribute("cy", -46 * v);
    byId("where").textContent = `Lamp ${Math.round(lamp.elevation * 180 / Math.PI)}° high, ${lamp.distance.toPrecision(3)} ${scene.unit} away`;
  }

  // --- hands ----------------------------------------------------------------------------------------------------

  function drag(dx, dy, what) {
    if (what === "light") {
      const [u, v] = lampFromAbove();
      putLamp(u + LIGHT_PER_PX * dx, v - LIGHT_PER_PX * dy);
    } else {
      const turned = -TURN_PER_PX * dx;
      view.azimuth += turned;
      view.elevation = clamp(view.elevation + TURN_PER_PX * dy, LOWEST, HIGHEST);
      restart();
    }
  }

  function zoom(factor) {
    view.distance = clamp(view.distance * factor, home.distance * 0.3, home.distance * 3);
    restart();
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    canvas.setPointerCapture(e.pointerId);
  });
  canvas.addEventListener("pointermove", (e) => {
    const was = fingers.get(e.pointerId);
    if (!was) return;
    const others = [...fingers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (others.length) {
      const gap = (p) => Math.hypot(p[0] - others[0][0], p[1] - others[0][1]);
      zoom(gap(was) / Math.max(1, gap([e.clientX, e.clientY])));
      drag((e.clientX - was[0]) / 2, (e.clientY - was[1]) / 2, "view");
    } else {
      const other = e.buttons & 2 || e.shiftKey;
      drag(e.clientX - was[0], e.clientY - was[1], other ? (drags === "light" ? "view" : "light") : drags);
    }
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(e.deltaY > 0 ? ZOOM_PER_NOTCH : 1 / ZOOM_PER_NOTCH); }, { passive: false });
  canvas.addEventListener("dblclick", () => { view = { ...home }; lamp = { ...scene.lamp, radius: lamp.radius, strength: lamp.strength }; restart(); });
  canvas.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: [-14, 0], ArrowRight: [14, 0], ArrowUp: [0, -14], ArrowDown: [0, 14] }[e.key];
    if (step) { e.preventDefault(); drag(...step, e.shiftKey ? (drags === "light" ? "view" : "light") : drags); }
    if (e.key === "+" || e.key === "-") zoom(e.key === "-" ? ZOOM_PER_NOTCH : 1 / ZOOM_PER_NOTCH);
  });
  canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); sayProblem("The graphics card gave up. Reload the page."); });

  const dome = byId("dome");
  const onDome = (e) => {
    const box = dome.getBoundingClientRect(), half = box.width / 2 * 0.92;
    putLamp((e.clientX - box.left - box.width / 2) / half, -(e.clientY - box.top - box.height / 2) / half);
  };
  dome.addEventListener("pointerdown", (e) => { dome.setPointerCapture(e.pointerId); onDome(e); });
  dome.addEventListener("pointermove", (e) => { if (e.buttons & 1) onDome(e); });

  for (const [id, what] of [["drag-light", "light"], ["drag-view", "view"]]) byId(id).addEventListener("click", () => {
    drags = what;
    byId("drag-light").setAttribute("aria-pressed", String(what === "light"));
    byId("drag-view").setAttribute("aria-pressed", String(what === "view"));
  });
  byId("softness").value = Math.sqrt(scene.lamp.radius / scene.largestLamp);
  byId("softness").addEventListener("input", (e) => { lamp.radius = scene.largestLamp * e.target.value ** 2; restart(); });
  byId("brightness").addEventListener("input", (e) => { lamp.strength = scene.lamp.strength * 2 ** e.target.value; restart(); });
  window.addEventListener("resize", () => restart(false));

  function sayProblem(text) {
    byId("problem").hidden = false;
    byId("problem").textContent = text;
  }

  // For whoever embeds the page: where camera and lamp are (radians and the scene's unit), and how to move them.
  window.shadowgraph = {
    state: () => ({ view: { ...view }, lamp: { ...lamp }, samples: count, finest: sharp ? sharp.samples : 0 }),
    set: (state) => { Object.assign(view, state.view); Object.assign(lamp, state.lamp); restart(false); },
  };
  begin().catch((error) => sayProblem(`Only a still picture can be shown here: ${error.message}.`));
})();

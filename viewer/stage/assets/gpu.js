// WebGL 2: programs, textures and targets.
import { byId } from "./scene.js";

export let gl = null;
let plain = null;
export let sharp = null;     // format of a target that averages samples

export function openCanvas(canvas) {
  gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser shows no WebGL 2");
  if (gl.getExtension("EXT_color_buffer_float")) sharp = { internal: gl.RGBA32F, type: gl.FLOAT, samples: 32 };
  else if (gl.getExtension("EXT_color_buffer_half_float")) sharp = { internal: gl.RGBA16F, type: gl.HALF_FLOAT, samples: 16 };
  else throw new Error("this graphics card draws no floating-point pictures");
}

// `defines` are lines that go right below the version of both shaders.
export function program(vertex, fragment, defines = "") {
  const made = gl.createProgram(), at = {}, shaders = [];
  for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, byId(name).textContent.trim().replace("\n", `\n${defines}\n`));
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    shaders.push(shader);
  }
  gl.linkProgram(made);
  let isChecked = false;  // at the first use: until then it compiles beside the page
  const check = () => {
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
      throw new Error(gl.getProgramInfoLog(made) || shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" "));
    }
    isChecked = true;
  };
  return { made, at: (name) => { if (!isChecked) check(); return (at[name] ??= gl.getUniformLocation(made, name)); } };
}

export function flat(filter) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  return texture;
}

export function pictureTexture(picture, isColour) {
  const texture = flat(gl.LINEAR);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, isColour ? gl.SRGB8_ALPHA8 : gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  return texture;
}

// Shares of a square, one byte each.
export function shareTexture(shares, side) {
  const texture = flat(gl.LINEAR);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, side, side, 0, gl.RED, gl.UNSIGNED_BYTE, shares);
  return texture;
}

function depthTexture(width, height, compares) {
  const texture = flat(compares ? gl.LINEAR : gl.NEAREST);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, width, height);
  if (compares) {
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL);
  }
  return texture;
}

// A target with these colour formats, and a depth texture where asked for: 0 none, 1 plain, 2 that compares.
export function target(width, height, formats, depth) {
  const frame = gl.createFramebuffer(), textures = [];
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  formats.forEach(([internal, type, kind], i) => {
    const texture = flat(gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, kind || gl.RGBA, type, null);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    textures.push(texture);
  });
  gl.drawBuffers(formats.length ? formats.map((_, i) => gl.COLOR_ATTACHMENT0 + i) : [gl.NONE]);
  let depthMap = null;
  if (depth) {
    depthMap = depthTexture(width, height, depth === 2);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depthMap, 0);
  }
  return { frame, textures, depthMap, width, height };
}

export function drop(old) {
  if (!old) return;
  for (const texture of [...old.textures, old.depthMap]) if (texture) gl.deleteTexture(texture);
  gl.deleteFramebuffer(old.frame);
}

// Draws while a comparing depth texture in this unit gives its depth instead.
export function plainDepth(unit, draw) {
  if (!plain) {
    plain = gl.createSampler();
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.samplerParameteri(plain, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.samplerParameteri(plain, name, gl.CLAMP_TO_EDGE);
  }
  gl.bindSampler(unit, plain);
  draw();
  gl.bindSampler(unit, null);
}

export function bind(shader, textures) {
  textures.forEach(([name, texture], i) => {
    gl.activeTexture(gl.TEXTURE0 + i);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(shader.at(name), i);
  });
}

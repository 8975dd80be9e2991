#version 300 es
// Lines in space; those behind the surface are fainter.
precision highp float;
uniform sampler2D depthMap;
uniform vec2 full;       // px of the canvas
in vec4 paint;
out vec4 result;

void main() {
  vec2 size = vec2(textureSize(depthMap, 0));
  float front = texelFetch(depthMap, ivec2(gl_FragCoord.xy / full * size), 0).r;
  float share = gl_FragCoord.z > front + 2e-5 ? 0.12 : 1.0;
  result = vec4(paint.rgb, paint.a * share);
}

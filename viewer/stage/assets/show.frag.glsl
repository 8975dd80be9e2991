#version 300 es
// Linear colour to sRGB; nothing else is done to it. SAME: the picture has the canvas's pixels.
precision highp float;
uniform sampler2D picture;
uniform vec2 scale;  // pixels of the picture per pixel of the canvas
out vec4 result;

void main() {
#ifdef SAME
  vec3 x = texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb;
#else
  // Bilinear by hand: not every graphics card filters floating-point pictures.
  vec2 at = gl_FragCoord.xy * scale - 0.5;
  ivec2 low = ivec2(floor(at)), most = textureSize(picture, 0) - 1;
  vec2 part = fract(at);
  vec3 corner[4];
  for (int i = 0; i < 4; i++) corner[i] = texelFetch(picture, clamp(low + ivec2(i & 1, i >> 1), ivec2(0), most), 0).rgb;
  vec3 x = mix(mix(corner[0], corner[1], part.x), mix(corner[2], corner[3], part.x), part.y);
#endif
  result = vec4(mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, greaterThan(x, vec3(0.0031308))), 1.0);
}

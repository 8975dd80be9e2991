#version 300 es
// Triangles of the object or of the ground, seen from the eye, from the lamp or from the photo's camera.
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec4 colour;  // sRGB, and what is known: 0 a guess, 1 seen
layout(location = 3) in vec4 gloss;   // weights of the glossy materials
uniform mat4 clip;
out vec3 at;
out vec3 facing;
out vec4 paint;
out vec4 shine;

void main() {
  at = place;
  facing = normal;
  vec3 c = colour.rgb;
  paint = vec4(mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), greaterThan(c, vec3(0.04045))), colour.a);
  shine = gloss;
  gl_Position = clip * vec4(place, 1.0);
}

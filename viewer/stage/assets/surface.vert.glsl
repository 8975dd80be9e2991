#version 300 es
// Triangles of the object or of the ground, seen from the eye, from the lamp or from the photo's camera.
// PLAIN: places alone, for depth where nothing is cut away.
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec4 normal;  // and the sky's share as seen from below
layout(location = 2) in vec4 colour;  // square roots of linear colour, and what is known: 0 a guess, 1 seen
layout(location = 3) in vec4 gloss;   // weights of the glossy materials
layout(location = 4) in vec4 bounce;  // of a lamp's light: reconstruct/render/soft_light.py
layout(location = 5) in vec4 tintSky; // of what bounces, and the sky's share
uniform mat4 clip;
uniform bool isBelow;
uniform float bounceScale;
#ifndef PLAIN
out vec4 bounced;
out vec4 soft;
out vec3 at;
out vec3 facing;
out vec4 paint;
out vec4 shine;
#endif

void main() {
#ifndef PLAIN
  at = place;
  facing = normal.xyz;
  bounced = isBelow ? vec4(0.0) : bounce * bounceScale;
  soft = vec4(tintSky.rgb, isBelow ? normal.w : tintSky.a);
  paint = vec4(colour.rgb * colour.rgb, colour.a);
  shine = gloss;
#endif
  gl_Position = clip * vec4(place, 1.0);
}

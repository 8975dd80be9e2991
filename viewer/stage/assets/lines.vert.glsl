#version 300 es
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec4 colour;
uniform mat4 clip;
out vec4 paint;

void main() {
  paint = colour;
  gl_Position = clip * vec4(place, 1.0);
}

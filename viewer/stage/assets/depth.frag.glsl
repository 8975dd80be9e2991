#version 300 es
// Depth alone, of what is not cut away. PLAIN: nothing is.
precision highp float;
#ifdef PLAIN
void main() {}
#else
uniform vec3 cropLow, cropHigh;
uniform bool cutGuess;
in vec3 at;
in vec4 paint;

void main() {
  if (any(lessThan(at, cropLow)) || any(greaterThan(at, cropHigh)) || (cutGuess && paint.a < 0.25)) discard;
}
#endif

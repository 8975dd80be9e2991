#version 300 es
// The object's normals, averaged along one axis of the screen over neighbours on the same surface.
precision highp float;
uniform sampler2D normalMap, depthMap;
uniform vec2 step_;      // px between taps
uniform vec2 nearFar;
uniform float nearby;    // radii of the object: a neighbour farther off in depth is another surface
out vec4 result;

float depth(ivec2 at) {
  float d = texelFetch(depthMap, at, 0).r * 2.0 - 1.0;
  return 2.0 * nearFar.x * nearFar.y / (nearFar.y + nearFar.x - d * (nearFar.y - nearFar.x));
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(normalMap, 0) - 1;
  vec4 own = texelFetch(normalMap, at, 0);
  result = own;
  if (own.a < 1.5) return;
  float here = depth(at);
  vec3 sum = vec3(0.0);
  for (int i = -4; i <= 4; i++) {
    ivec2 to = clamp(at + ivec2(round(float(i) * step_)), ivec2(0), most);
    vec4 other = texelFetch(normalMap, to, 0);
    if (other.a < 1.5 || abs(depth(to) - here) > nearby * (1.0 + abs(float(i)))) continue;
    sum += exp(-0.5 * float(i * i) / 4.0) * other.rgb;
  }
  result = vec4(dot(sum, sum) > 0.0 ? normalize(sum) : own.rgb, own.a);
}

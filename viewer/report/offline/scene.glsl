#version 300 es
// One sample per pixel of a solved scene: rays through a signed distance function, lit by one lamp of some size.
// Lengths are voxels, from node (0, 0, 0) of the grid; z is up. Colours are linear.
precision highp float;
precision highp sampler3D;

uniform sampler3D distances;  // negative inside
uniform sampler3D colours;    // albedo
uniform sampler2D groundPicture;
uniform vec3 nodes;           // of the grid along each axis
uniform float groundHeight;
uniform vec2 groundCentre;
uniform float groundHalf;     // half the side of the ground's picture
uniform vec3 groundMean;      // albedo beyond it
uniform vec3 background;
uniform float fadeFrom, fadeTo;  // distance from the object at which the ground fades into the background
uniform vec3 eye, right, down, forward;
uniform vec2 size;            // of the picture, px
uniform float focal;          // px
uniform vec3 lamp;
uniform float lampRadius;
uniform float strength;       // irradiance times distance^2
uniform float ambient;
uniform vec2 jitter;          // of the pixel, px
uniform float turn;           // of the lamp's sample, in revolutions
uniform float reach;          // of the lamp's sample, 0 the middle, 1 the rim
uniform sampler2D before;     // mean of the samples so far
uniform float share;          // of this sample in the new mean
out vec4 result;

const float LIFT = 1.0;       // voxels above the object where shadow rays start, as in Shadowgraph's own renderer
const float CAUTION = 0.9;    // of the distance that a ray steps: the field is not exact between nodes
const float LEAST = 0.04;     // voxels
const int STEPS = 192;
const float NOTHING = 1e9;

float field(vec3 p) {
  vec3 inside = clamp(p, vec3(0.0), nodes - 1.0);
  return texture(distances, (inside + 0.5) / nodes).r + length(p - inside);
}

// Distance along the ray to the surface, or NOTHING before `far`.
float march(vec3 origin, vec3 direction, float far) {
  vec3 safe = mix(direction, vec3(1e-9), lessThan(abs(direction), vec3(1e-9)));
  vec3 a = (vec3(0.0) - origin) / safe, b = (nodes - 1.0 - origin) / safe;
  vec3 low = min(a, b), high = max(a, b);
  float t = max(max(low.x, low.y), max(low.z, 0.0));
  far = min(far, min(high.x, min(high.y, high.z)));
  float last = t, lastDistance = 1.0;
  for (int i = 0; i < STEPS && t < far; i++) {
    float d = field(origin + t * direction);
    if (d < 0.0) return mix(last, t, lastDistance / (lastDistance - d));
    last = t;
    lastDistance = d;
    t += max(CAUTION * d, LEAST);
  }
  return NOTHING;
}

vec3 slope(vec3 p) {
  vec2 h = vec2(0.5, 0.0);
  return normalize(vec3(field(p + h.xyy) - field(p - h.xyy),
                        field(p + h.yxy) - field(p - h.yxy),
                        field(p + h.yyx) - field(p - h.yyx)));
}

float hash(vec2 p) { return fract(sin(dot(p, vec2(12.9898, 78.233))) * 43758.5453); }

// A point of the lamp's disc, which faces p.
vec3 lampPoint(vec3 p) {
  vec3 axis = normalize(lamp - p);
  vec3 across = normalize(abs(axis.z) < 0.9 ? cross(axis, vec3(0, 0, 1)) : cross(axis, vec3(1, 0, 0)));
  float angle = 6.2831853 * (turn + hash(gl_FragCoord.xy));
  return lamp + lampRadius * reach * (cos(angle) * across + sin(angle) * cross(axis, across));
}

void main() {
  vec2 at = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) + jitter - 0.5 * size;
  vec3 ray = normalize(focal * forward + at.x * right + at.y * down);
  float toGround = ray.z < 0.0 ? (groundHeight - eye.z) / ray.z : NOTHING;
  float toObject = march(eye, ray, min(toGround, NOTHING));
  vec3 colour = background;
  if (min(toObject, toGround) < NOTHING) {
    bool isObject = toObject < toGround;
    vec3 p = eye + min(toObject, toGround) * ray;
    vec3 normal = isObject ? slope(p) : vec3(0, 0, 1);
    vec2 place = (p.xy - groundCentre) / groundHalf;
    vec3 albedo = isObject ? texture(colours, (p + 0.5) / nodes).rgb
      : max(abs(place.x), abs(place.y)) < 1.0 ? texture(groundPicture, 0.5 + 0.5 * vec2(place.x, -place.y)).rgb
      : groundMean;
    vec3 start = isObject ? p + LIFT * normal : p;
    vec3 target = lampPoint(p) - start;
    float distance = length(target);
    vec3 towards = target / distance;
    float facing = max(dot(normal, towards), 0.0);
    float seen = facing > 0.0 && march(start, towards, distance) >= NOTHING ? 1.0 : 0.0;
    vec3 lampWay = lamp - p;
    colour = albedo * (ambient + strength * facing * seen / dot(lampWay, lampWay));
    if (!isObject) colour = mix(colour, background, smoothstep(fadeFrom, fadeTo, length(p.xy - groundCentre)));
  }
  vec4 old = texelFetch(before, ivec2(gl_FragCoord.xy), 0);
  result = vec4(mix(old.rgb, min(colour, vec3(1.0)), share), 1.0);
}

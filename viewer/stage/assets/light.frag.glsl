#version 300 es
// One sample of the lit picture from the G-buffer and the shadow map. Colours are linear.
precision highp float;
precision highp sampler2DShadow;
//#photo
uniform sampler2D albedoMap, normalMap, glossMap, blurMap, depthMap;
uniform highp usampler2D softMap;
uniform sampler2DShadow shadowMap;
uniform sampler2D shadowDepth;   // the same, without comparing
uniform vec4 shadowView;         // near, far, focal length over half a side; radius of the lamp's part
uniform float numbered;          // of this sample
uniform mat4 shadowClip;
uniform float lift;            // along the normal, before a place is looked up in the shadow map
uniform vec3 eye, right, down, forward;
uniform vec2 size, shift;      // of the picture, px; of its middle, px
uniform float focal;           // px
uniform vec2 nearFar;
uniform vec3 lamp;
uniform float strength;        // irradiance times distance^2
uniform float ambient;
uniform vec3 background;
uniform vec2 fade;
// LOOK is a place in LOOKS of state.js; GLOSS: how many materials have lobes; ROOM: there are surroundings; WIPE: a photo
// is beside it; BLUR: normals are smoothed; MOVING: for the screen at once, else one sample of a mean.
uniform float gain;            // of a look that enhances
uniform float sharpness;       // exponent of the enhanced highlight
uniform float worldPx;         // radii of the object per blur step, for curvature
uniform bool markGuess;
uniform float lobes[108];      // of four materials: nine lobes times RGB
uniform float lobeSharpness[9], lobeFacing[9];
uniform vec3 chosenAlbedo;     // below 0: the recovered one
uniform bool chosenGloss;
uniform float turn;            // of the surroundings, rad
uniform sampler2D photo;
uniform float wipe;            // px: left of it the chosen photo is shown
uniform sampler2D before;      // mean of the samples so far
uniform float share;           // of this sample in the new mean
out vec4 result;

#ifdef MOVING
const int SEARCHED = 6, TAPS = 8;
#else
const int SEARCHED = 4, TAPS = 4;
#endif
const float SKY_BOUNCE = 12.0 / 7.0;  // the overcast sky's radiance over all its directions, where level ground receives 1
const float GRAZING = 0.05, DIELECTRIC = 0.04;

const vec2 GOLDEN_TURN = vec2(-0.73736888, 0.67549029);  // cosine and sine of 2.4 rad

vec2 turnedBy(vec2 v, vec2 by) { return vec2(v.x * by.x - v.y * by.y, v.x * by.y + v.y * by.x); }

// Share of the lamp's part that a place sees: what hides it is looked for first, for the shadow's edge is as wide as
// that is far away [Fernando 2005, Percentage-closer soft shadows]. Each pixel turns its taps by an angle of its own
// [Jimenez 2014, interleaved gradient noise], so that few give grain, not steps, and the mean of the samples neither.
float shadow(vec3 p, vec3 n, float facing) {
  vec4 there = shadowClip * vec4(p, 1.0);
  float z = there.w;
  if (z <= 0.0) return 1.0;
  vec3 at = there.xyz / z * 0.5 + 0.5;
  if (any(lessThan(at.xy, vec2(0.0))) || any(greaterThan(at.xy, vec2(1.0)))) return 1.0;
  at.z = min(at.z, 1.0);  // behind the object lies the ground, farther than the map reaches
  float middle = texture(shadowMap, at);
  if (shadowView.w <= 0.0) return middle;
  float near = shadowView.x, far = shadowView.y, reach = 0.5 * shadowView.z * shadowView.w;
  // Depth along the receiver's own plane, per step across the map: what lies behind the plane hides nothing.
  vec2 slope = 2.0 * far * near / (far - near) * (shadowClip * vec4(n, 0.0)).xy / (shadowView.z * shadowView.z * facing);
  float angle = 6.2831853 * fract(52.9829189 * fract(dot(gl_FragCoord.xy + 5.588238 * numbered, vec2(0.06711056, 0.00583715))));
  vec2 way = vec2(cos(angle), sin(angle)), step_;
  float widest = reach * (z - near) / (near * z), sum = 0.0, found = 0.0;
  for (int i = 0; i <= SEARCHED; i++) {
    step_ = widest * float(i) / float(SEARCHED) * way;
    float d = texture(shadowDepth, at.xy + step_).r;
    if (d < at.z + min(dot(slope, step_), 0.0)) { sum += 2.0 * far * near / (far + near - (2.0 * d - 1.0) * (far - near)); found += 1.0; }
    way = turnedBy(way, GOLDEN_TURN);
  }
  if (found == 0.0) return 1.0;
  float before = sum / found, wide = reach * max(z - before, 0.0) / (before * z), share = 0.0;
  for (int i = 0; i < TAPS; i++) {
    step_ = wide * sqrt((float(i) + 0.5) / float(TAPS)) * way;
    share += texture(shadowMap, vec3(at.xy + step_, at.z + min(dot(slope, step_), 0.0)));
    way = turnedBy(way, GOLDEN_TURN);
  }
  return share / float(TAPS);
}

#ifdef GLOSS
vec3 lobe(int k, vec4 weights) {
  vec3 sum = vec3(0.0);
  for (int m = 0; m < GLOSS; m++) {
    int i = 27 * m + 3 * k;
    sum += weights[m] * vec3(lobes[i], lobes[i + 1], lobes[i + 2]);
  }
  return sum;
}

#endif

#ifdef ROOM
// Radiance of a room with two windows and a ceiling; `blur` is how far a rough surface sees around a direction.
vec3 room(vec3 d, float blur) {
  float c = cos(turn), s = sin(turn);
  d.xy = vec2(c * d.x + s * d.y, c * d.y - s * d.x);
  float up = smoothstep(-0.25 - blur, 0.25 + blur, d.z);
  vec3 sum = mix(vec3(0.16, 0.15, 0.14), vec3(0.34, 0.35, 0.37), up);
  float left = dot(d, vec3(0.48, -0.76, 0.44)), back = dot(d, vec3(-0.62, 0.55, 0.56)), top = d.z;
  float wide = 0.06 + 0.9 * blur;
  sum += vec3(2.4, 2.5, 2.7) * smoothstep(0.9 - wide, 0.9 + wide, left) / (1.0 + 4.0 * blur);
  sum += vec3(1.7, 1.6, 1.45) * smoothstep(0.88 - wide, 0.88 + wide, back) / (1.0 + 4.0 * blur);
  sum += vec3(0.8) * smoothstep(0.85 - wide, 0.85 + wide, top) / (1.0 + 2.0 * blur);
  return sum;
}

#endif

#ifdef GLOSS
// Sum of lobes with Fresnel term, of Ashikhmin and Shirley's shape, as reconstruct/appearance/brdf.py states it.
vec3 mirrored(vec3 n, vec3 towards, vec3 view, vec4 weights, out vec3 facing, out float blur) {
  vec3 halfway = normalize(towards + view), sum = vec3(0.0);
  float cosine = dot(n, halfway) - 1.0, logs = 0.0, total = 1e-9;
  facing = vec3(0.0);
  for (int k = 0; k < 9; k++) {
    vec3 c = lobe(k, weights);
    sum += c * exp(lobeSharpness[k] * cosine);
    vec3 f = c * lobeFacing[k];
    facing += f;
    logs += dot(f, vec3(1.0)) * log(lobeSharpness[k]);
    total += dot(f, vec3(1.0));
  }
  blur = clamp(sqrt(2.0 / exp(logs / total)), 0.0, 1.0);
  float along = clamp(dot(towards, halfway), GRAZING, 1.0);
  float steepest = max(max(dot(n, towards), dot(n, view)), GRAZING);
  vec3 rest = 1.0 / clamp(facing, DIELECTRIC, 1.0) - 1.0;
  return sum * (1.0 + rest * pow(1.0 - along, 5.0)) / (along * steepest);
}

#endif

#ifdef MOVING
// sRGB to half a step of 255, by three square roots.
vec3 toScreen(vec3 x) {
  vec3 a = sqrt(x), b = sqrt(a), c = sqrt(b);
  return max(0.662002687 * a + 0.684122060 * b - 0.323583601 * c - 0.0225411470 * x, 0.0);
}
#endif

#if LOOK == 3
// Mean curvature times the object's radius: how the blurred normals spread on the screen, over how far apart they are.
float curvature(ivec2 at) {
  ivec2 most = textureSize(blurMap, 0) - 1;
  vec4 l = texelFetch(blurMap, clamp(at - ivec2(2, 0), ivec2(0), most), 0), r = texelFetch(blurMap, clamp(at + ivec2(2, 0), ivec2(0), most), 0);
  vec4 b = texelFetch(blurMap, clamp(at - ivec2(0, 2), ivec2(0), most), 0), t = texelFetch(blurMap, clamp(at + ivec2(0, 2), ivec2(0), most), 0);
  if (min(min(l.a, r.a), min(b.a, t.a)) < 1.5) return 0.0;
  return (dot(normalize(r.rgb) - normalize(l.rgb), right) - dot(normalize(t.rgb) - normalize(b.rgb), down)) / (8.0 * worldPx);
}
#endif

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 surface = texelFetch(normalMap, at, 0);
  vec3 colour = background;
  if (surface.a > 0.5) {
    vec4 paint = texelFetch(albedoMap, at, 0);
    vec3 n = normalize(surface.rgb), albedo = paint.rgb * paint.rgb;
    float d = texelFetch(depthMap, at, 0).r * 2.0 - 1.0;
    float z = 2.0 * nearFar.x * nearFar.y / (nearFar.y + nearFar.x - d * (nearFar.y - nearFar.x));
    vec2 q = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5 * size - shift;
    vec3 p = eye + z * (forward + (q.x * right + q.y * down) / focal);
    bool isObject = surface.a > 1.5;
    vec3 geometric = n;
#if defined(BLUR) || LOOK == 2
    vec4 blurred = texelFetch(blurMap, at, 0);
#endif
#ifdef BLUR
    if (isObject) n = normalize(blurred.rgb);
#endif
#if LOOK == 2
    if (isObject) n = normalize(n + gain * (n - normalize(blurred.rgb)));
#endif
    bool isSwapped = isObject && chosenAlbedo.x >= 0.0;
    if (isSwapped) albedo = chosenAlbedo;
#if LOOK == 6
    if (isObject) albedo = vec3(0.75);
#endif
    vec3 way = lamp - p, towards = normalize(way), view = normalize(eye - p);
    float facing = max(dot(n, towards), 0.0);
    float lit = facing > 0.0 ? shadow(isObject ? p + lift * geometric : p, geometric, max(dot(geometric, way), GRAZING)) : 0.0;
    float sent = strength / dot(way, way);
    uvec4 around = texelFetch(softMap, at, 0);
    vec4 bounce = vec4(unpackSnorm2x16(around.x), unpackSnorm2x16(around.y)), tintSky = vec4(unpackUnorm2x16(around.z), unpackUnorm2x16(around.w));
    float bounced = strength / dot(lamp, lamp) * max(0.0, dot(bounce, vec4(1.0, normalize(lamp)))) + ambient * max(0.0, SKY_BOUNCE * bounce.x + bounce.w);
    vec3 light = vec3(ambient * tintSky.a + sent * facing * lit) + tintSky.rgb * bounced;
    colour = albedo * light;
    vec3 shine = vec3(0.0);
    float blur = 1.0;
#ifdef GLOSS
    if (isObject) {
      vec4 weights = chosenGloss ? vec4(1.0, 0.0, 0.0, 0.0) : texelFetch(glossMap, at, 0);
      colour += mirrored(n, towards, view, weights, shine, blur) * sent * facing * lit;
    }
#endif
#ifdef ROOM
    vec3 fresnel = shine + (1.0 - shine) * pow(1.0 - clamp(dot(n, view), 0.0, 1.0), 5.0) * (1.0 - blur) * step(1e-6, shine.r);
    float open = isObject ? 0.5 + 0.5 * clamp(p.z + 0.8, 0.0, 1.0) : 1.0;
    colour = 0.45 * colour + (albedo * 0.55 * room(n, 1.0) + fresnel * room(reflect(-view, n), blur)) * open;
#endif
#if LOOK == 1
    if (isObject) {
      float h = max(dot(n, normalize(towards + view)), 0.0);
      colour = 0.35 * colour + vec3(gain * 0.35 * pow(h, sharpness) * lit);
    }
#endif
#if LOOK == 3
    if (isObject) {
      float k = curvature(at) * gain;
      colour = vec3(0.42 + 0.42 * k / (1.0 + abs(k))) * (0.55 + 0.45 * facing * lit);
    }
#endif
#if LOOK == 7
    colour = albedo;
#endif
#if LOOK == 4
    if (isObject) colour = pow(0.5 + 0.5 * vec3(dot(n, right), -dot(n, down), -dot(n, forward)), vec3(2.2));
#endif
#if LOOK == 5
    if (isObject) {
      // As the legend's signs in stage.css: light and plain, striped, dark and crossed.
      vec2 across = fract((gl_FragCoord.xx + vec2(1.0, -1.0) * gl_FragCoord.y) / (size.y / 75.0));
      vec3 shadowed = across.x < 0.5 ? vec3(0.791, 0.347, 0.0) : vec3(0.254, 0.102, 0.0);
      vec3 guessed = min(across.x, across.y) < 0.17 ? vec3(0.371, 0.115, 0.305) : vec3(0.074, 0.009, 0.056);
      vec3 said = mix(guessed, mix(shadowed, vec3(0.624, 0.791, 0.930), smoothstep(0.7, 0.8, paint.a)), smoothstep(0.2, 0.3, paint.a));
      colour = said * (0.25 + 0.9 * light);
    }
#endif
    if (isObject && markGuess && paint.a < 0.25) {
      float stripe = fract((gl_FragCoord.x + gl_FragCoord.y) / (size.y / 75.0));
      colour = mix(colour, vec3(0.9, 0.25, 0.08) * (0.2 + 0.8 * light), stripe < 0.5 ? 0.55 : 0.12);
    }
#ifdef WIPE
    vec3 spot = inPhoto(p);
    if (gl_FragCoord.x < wipe && spot.z > 0.0 && all(greaterThan(spot.xy, vec2(0.0))) && all(lessThan(spot.xy, vec2(1.0)))) {
      colour = texture(photo, spot.xy).rgb;
    }
#endif
    if (!isObject) colour = mix(colour, background, (1.0 - paint.a) * smoothstep(fade.x, fade.y, length(p.xy)));
  }
  colour = min(colour, vec3(1.0));
#ifdef MOVING
  result = vec4(toScreen(colour), 1.0);
#else
  result = vec4(share < 1.0 ? mix(texelFetch(before, at, 0).rgb, colour, share) : colour, 1.0);
#endif
}

#version 300 es
// The G-buffer: albedo with what is known of it, normal with its kind, weights of gloss.
// GROUND: of the ground, else of the object. CUT: a part may be cut away. NORMALS, FINE: pictures of normals, and of the
// photo's own pixels. HOME: seen from the photo's place, so that the photo shows all that is seen. GLOSS: there are weights.
precision highp float;
precision highp sampler2DShadow;
//#photo
uniform vec3 groundMean;
uniform sampler2D objectPicture, normalPicture, groundPicture;
uniform vec4 objectWindow;           // left, top, width, height in shares of the photo
uniform sampler2D finePicture, fineNormals;  // of the photo's own pixels
uniform sampler2DShadow seenMap;     // depth as the photo's camera sees it
uniform mat4 seenClip;
uniform float lift;                  // along the normal, before a place is looked up in seenMap
uniform vec3 cropLow, cropHigh;
uniform bool cutGuess;
uniform sampler2D groundSky;
uniform float groundHalf;            // of the square that groundSky tells of
in vec4 bounced;
in vec4 soft;
in vec3 at;
in vec3 facing;
in vec4 paint;
in vec4 shine;
layout(location = 0) out vec4 albedo;    // the square root of it; alpha: what is known
layout(location = 1) out vec4 normal;    // alpha: 1 the ground, 2 the object, 3 its inside
layout(location = 2) out uvec4 around;   // soft light: what bounces, its tint, the sky's share
#ifdef GLOSS
layout(location = 3) out vec4 gloss;
#endif

const float EDGE = 0.06;             // of the photo, over which its ground goes over into the mean colour
const float GUESS = 0.25;            // what is known below this is a guess

void keep(vec4 bounce, vec4 tintSky) {
  around = uvec4(packSnorm2x16(bounce.xy), packSnorm2x16(bounce.zw), packUnorm2x16(tintSky.xy), packUnorm2x16(tintSky.zw));
}

// Irradiance under the overcast sky of a surface whose normal has this height, over that of level ground.
float overcast(float up) { return 0.396 + up * (0.5 + 0.104 * up); }

void main() {
  vec3 spot = inPhoto(at);
#ifdef GLOSS
  gloss = vec4(0.0);
#endif
#ifdef GROUND
  vec2 toEdge = min(spot.xy, 1.0 - spot.xy);
  float share = spot.z * clamp(min(toEdge.x, toEdge.y) / EDGE, 0.0, 1.0);
  vec3 colour = mix(groundMean, texture(groundPicture, spot.xy).rgb, share);
  albedo = vec4(sqrt(colour), share);
  normal = vec4(0.0, 0.0, 1.0, 1.0);
  keep(vec4(0.0), vec4(1.0, 1.0, 1.0, texture(groundSky, 0.5 + 0.5 * at.xy / groundHalf).r));
#else
  vec3 n = normalize(facing);
#ifdef CUT
  if (any(lessThan(at, cropLow)) || any(greaterThan(at, cropHigh)) || (cutGuess && paint.a < GUESS)) discard;
  if (!gl_FrontFacing) {
    albedo = vec4(vec3(0.35), 0.0);
    normal = vec4(-n, 3.0);
    keep(vec4(0.0), vec4(1.0, 1.0, 1.0, 0.5));
    return;
  }
#endif
  vec3 colour = paint.rgb;
  vec2 inWindow = (spot.xy - objectWindow.xy) / objectWindow.zw;
  vec2 border = min(inWindow, 1.0 - inWindow);
  if (spot.z > 0.0 && min(border.x, border.y) > 0.0) {
    float slope = dot(n, normalize(cameraEye - at)), share = smoothstep(0.05, 0.3, slope);
#ifndef HOME
    vec4 there = seenClip * vec4(at + lift * n, 1.0);
    share *= texture(seenMap, there.xyz / there.w * 0.5 + 0.5);
#endif
    vec3 shown = texture(objectPicture, inWindow).rgb, fine = n;
#ifdef NORMALS
    fine = 2.0 * texture(normalPicture, inWindow).rgb - 1.0;
#endif
#ifdef FINE
    shown = texture(finePicture, inWindow).rgb;
    fine = 2.0 * texture(fineNormals, inWindow).rgb - 1.0;
#endif
    colour = mix(colour, shown, share);
    n = normalize(mix(n, fine, share));
  }
  float sky = soft.a;
#if defined(NORMALS) || defined(FINE)
  sky *= clamp(overcast(n.z) / max(overcast(normalize(facing).z), 0.05), 0.5, 2.0);  // what is finer than the mesh
#endif
  keep(bounced, vec4(soft.rgb, min(sky, 1.0)));
  albedo = vec4(sqrt(colour), paint.a);
  normal = vec4(n, 2.0);
#ifdef GLOSS
  gloss = shine;
#endif
#endif
}

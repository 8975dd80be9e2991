// Where the photo shows a place. Lengths are radii of the object, from its middle; z is up.
uniform vec3 cameraEye;
uniform mat3 cameraAxes;     // columns: right, down, forward
uniform vec2 cameraFocal, cameraMiddle;  // shares of the picture's width and height
uniform float distortion[5];  // OpenCV's k1 k2 p1 p2 k3, or k1 to k4 of a fisheye
uniform bool fisheye;
uniform float field;         // tangent of the largest angle from the axis in the picture

// Shares of the photo's width and height, from its top left corner; z is 0 where the camera cannot show the place.
vec3 inPhoto(vec3 p) {
  vec3 q = (p - cameraEye) * cameraAxes;
  if (q.z < 1e-4) return vec3(0.0);
  vec2 x = q.xy / q.z;
  float r2 = dot(x, x);
  if (fisheye) {
    float r = max(sqrt(r2), 1e-9), t = atan(r), t2 = t * t;
    float bent = t * (1.0 + t2 * (distortion[0] + t2 * (distortion[1] + t2 * (distortion[2] + t2 * distortion[3]))));
    return vec3(cameraMiddle + cameraFocal * x * (bent / r), 1.0);
  }
  if (r2 > field * field) return vec3(0.0);
  float along = 1.0 + r2 * (distortion[0] + r2 * (distortion[1] + r2 * distortion[4]));
  vec2 aside = vec2(2.0 * distortion[2] * x.x * x.y + distortion[3] * (r2 + 2.0 * x.x * x.x),
                    distortion[2] * (r2 + 2.0 * x.y * x.y) + 2.0 * distortion[3] * x.x * x.y);
  return vec3(cameraMiddle + cameraFocal * (along * x + aside), 1.0);
}

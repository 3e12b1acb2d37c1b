#part sine
// The sine of angles in turns. Whole turns are taken off here, not left to the GPU, whose own sine may be good near 0
// alone; the rest is folded onto a quarter turn, where an odd polynomial is within 2e-7 of the sine.
vec4 sine(vec4 s) {
  s -= round(s);
  vec4 t = min(abs(s), 0.5 - abs(s));
  vec4 q = t * t;
  vec4 p = 41.99998856 - 14.33702469 * q;
  p = -76.70366669 + p * q;
  p = 81.60520935 + p * q;
  p = -41.34170151 + p * q;
  p = 6.283185482 + p * q;
  return sign(s) * t * p;
}
vec4 cosine(vec4 s) {
  return sine(s - round(s) + 0.25);
}

#part plane
// One triangle that covers the target.
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(corner, 0.0, 1.0);
}

#part layer
// A product of matrices: 4 points (one in each target) x 4 neurons for each fragment. Activations are an array of four
// textures: layer = point mod 4, x = point div 4, y = neuron div 4.
uniform highp sampler2D weights;
uniform highp sampler2D bias;
uniform int quads;
#ifdef FIRST
uniform highp sampler2D points;
uniform int base;
#else
uniform highp sampler2DArray source;
#endif
#ifdef BACK
uniform highp sampler2DArray phases;
#endif
layout(location = 0) out vec4 out0;
layout(location = 1) out vec4 out1;
layout(location = 2) out vec4 out2;
layout(location = 3) out vec4 out3;
#ifdef FIRST
vec4 product(ivec2 at, int point, mat3x4 w, vec4 b) {
  int i = base + 4 * at.x + point;
  ivec2 place = ivec2(i & 2047, i >> 11);
  return w * texelFetch(points, place, 0).xyz + b;
}
#endif
vec4 finish(vec4 z, ivec2 at, int point) {
#if defined(BACK)
  return 6.283185307 * z * cosine(texelFetch(phases, ivec3(at, point), 0));
#elif defined(PHASE)
  return z;
#else
  return sine(z);
#endif
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
#ifdef BACK
  vec4 b = vec4(0.0);
#else
  vec4 b = texelFetch(bias, ivec2(at.y, 0), 0);
#endif
#ifdef FIRST
  mat3x4 w = mat3x4(
    texelFetch(weights, ivec2(0, at.y), 0),
    texelFetch(weights, ivec2(1, at.y), 0),
    texelFetch(weights, ivec2(2, at.y), 0));
  vec4 z0 = product(at, 0, w, b), z1 = product(at, 1, w, b), z2 = product(at, 2, w, b), z3 = product(at, 3, w, b);
#else
  vec4 z0 = b, z1 = b, z2 = b, z3 = b;
  for (int k = 0; k < quads; k++) {
    mat4 w = mat4(
      texelFetch(weights, ivec2(4 * k, at.y), 0),
      texelFetch(weights, ivec2(4 * k + 1, at.y), 0),
      texelFetch(weights, ivec2(4 * k + 2, at.y), 0),
      texelFetch(weights, ivec2(4 * k + 3, at.y), 0));
    z0 += w * texelFetch(source, ivec3(at.x, k, 0), 0);
    z1 += w * texelFetch(source, ivec3(at.x, k, 1), 0);
    z2 += w * texelFetch(source, ivec3(at.x, k, 2), 0);
    z3 += w * texelFetch(source, ivec3(at.x, k, 3), 0);
  }
#endif
  out0 = finish(z0, at, 0);
  out1 = finish(z1, at, 1);
  out2 = finish(z2, at, 2);
  out3 = finish(z3, at, 3);
}

#part bend
// Sines of phases; or, with SEED, where the sweep back begins: the output's weights times their cosines.
uniform highp sampler2DArray phases;
#ifdef SEED
uniform highp sampler2D weights;
#endif
layout(location = 0) out vec4 out0;
layout(location = 1) out vec4 out1;
layout(location = 2) out vec4 out2;
layout(location = 3) out vec4 out3;
vec4 bent(ivec2 at, int point) {
  vec4 phase = texelFetch(phases, ivec3(at, point), 0);
#ifdef SEED
  return 6.283185307 * texelFetch(weights, ivec2(at.y, 0), 0) * cosine(phase);
#else
  return sine(phase);
#endif
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  out0 = bent(at, 0);
  out1 = bent(at, 1);
  out2 = bent(at, 2);
  out3 = bent(at, 3);
}

#part value
// The first output, of four points for each fragment.
uniform highp sampler2DArray source;
uniform highp sampler2D weights;
uniform float bias;
uniform int quads;
out vec4 result;
void main() {
  int x = int(gl_FragCoord.x);
  vec4 sum = vec4(bias);
  for (int k = 0; k < quads; k++) {
    vec4 w = texelFetch(weights, ivec2(k, 0), 0);
    sum += vec4(
      dot(w, texelFetch(source, ivec3(x, k, 0), 0)),
      dot(w, texelFetch(source, ivec3(x, k, 1), 0)),
      dot(w, texelFetch(source, ivec3(x, k, 2), 0)),
      dot(w, texelFetch(source, ivec3(x, k, 3), 0)));
  }
  result = sum;
}

#part triple
// Three numbers for each point: three rows of weights times what is there, the end of the sweep back.
uniform highp sampler2DArray source;
uniform highp sampler2D weights;
uniform vec3 bias;
uniform int quads;
uniform int first;
out vec4 result;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int i = (at.y - first) * 2048 + at.x;
  vec3 sum = bias;
  for (int k = 0; k < quads; k++) {
    vec4 g = texelFetch(source, ivec3(i >> 2, k, i & 3), 0);
    sum += vec3(
      dot(g, texelFetch(weights, ivec2(k, 0), 0)),
      dot(g, texelFetch(weights, ivec2(k, 1), 0)),
      dot(g, texelFetch(weights, ivec2(k, 2), 0)));
  }
  result = vec4(sum, 1.0);
}

#part corner
// A corner of a triangle, or of the square around a point, as the camera sees it: row 0 of the target is the upper row of
// the picture. The position of a SHAPE counts from 0 to 1 along its box.
uniform vec3 eye;
uniform mat3 axes;
uniform vec4 lens;
uniform vec4 frame;
in vec3 position;
out vec3 way;
#ifdef SHAPE
uniform vec3 low;
uniform vec3 extent;
uniform float radius;
in vec3 normal;
in vec4 color;
out vec3 facing;
out vec4 own;
out vec2 disc;
#endif
void main() {
#ifdef SHAPE
  facing = normal;
  own = color;
  way = low + extent * position - eye;
  disc = radius > 0.0 ? 2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0 : vec2(0.0);
  // At least as wide as a pixel, or far points would be missed.
  way += axes * vec3(disc * max(radius, 0.71 * dot(way, axes[2]) / lens.x), 0.0);
#else
  way = position - eye;
#endif
  vec3 seen = way * axes;
  vec2 pixel = lens.xy * seen.xy + lens.zw * seen.z;
  vec2 place = 2.0 * (pixel + 0.5 * seen.z) / frame.xy - seen.z;
  float z = ((frame.w + frame.z) * seen.z - 2.0 * frame.w * frame.z) / (frame.w - frame.z);
  gl_Position = vec4(place, z, seen.z);
}

#part depth
in vec3 way;
out vec4 result;
void main() {
  result = vec4(length(way));
}

#part shape
// Normal and distance of a triangle or a disc, and its colour; what has no normals has those of its faces.
uniform vec3 eye;
uniform int across;
uniform float place;
in vec3 way;
in vec3 facing;
in vec4 own;
in vec2 disc;
layout(location = 0) out vec4 seen;
layout(location = 1) out vec4 color;
void main() {
  vec3 face = cross(dFdx(way), dFdy(way));
  if (dot(disc, disc) > 1.0) discard;
  if (across >= 0) { // what stands before a plane is cut away
    float plane = place - eye[across];
    if ((way[across] - plane) * plane < 0.0) discard;
  }
  vec3 normal = dot(facing, facing) > 0.0 ? facing : dot(face, way) > 0.0 ? -face : face;
  seen = vec4(dot(normal, normal) > 0.0 ? normalize(normal) : -normalize(way), length(way));
  color = own;
}

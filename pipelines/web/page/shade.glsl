#part shade
// Colours of what was traced: xyz is the normal, w the depth, 0 where nothing is. Rows from `ready` on are still those of
// the coarser picture; with more than one ray per pixel the colours are averaged, in light and not as stored.
uniform highp sampler2D fine;
uniform highp sampler2D coarse;
uniform highp sampler2D fineColor;
uniform highp sampler2D coarseColor;
uniform int ready;
uniform vec2 size;
uniform int shading;
uniform bool occluded;
uniform mat3 axes;
uniform vec4 lens;
uniform vec3 paper;
uniform vec3 clay;
// A plane across an axis: r is the value of the level that is seen at the places of a grid on it, gba those of the levels
// 0, 1 and 2 where they are coarser.
uniform highp sampler2D section;
uniform bool cut;
uniform int across;
uniform float place;
uniform vec4 extent;
uniform vec3 eye;
uniform vec3 bands;
uniform float spacing;
out vec4 result;
vec3 light(vec3 display) { return pow(display, vec3(2.2)); }
vec3 ray(vec2 pixel) { return normalize(axes * vec3((pixel - lens.zw) / lens.xy, 1.0)); }
vec3 matcap(vec3 n) {
  vec3 lamp = normalize(vec3(-0.5, 0.7, 0.6));
  float d = max(dot(n, lamp), 0.0);
  float rim = pow(1.0 - max(n.z, 0.0), 3.0);
  float shine = pow(max(dot(reflect(vec3(0.0, 0.0, -1.0), n), lamp), 0.0), 24.0);
  vec3 warm = vec3(0.62, 0.27, 0.16), cool = vec3(0.12, 0.14, 0.22);
  return mix(cool, warm, 0.25 + 0.75 * d) * (0.55 + 0.75 * d) + 0.22 * shine + 0.12 * rim * vec3(0.7, 0.8, 1.0);
}
ivec2 before(ivec2 at) {
  ivec2 rough = textureSize(coarse, 0);
  return min(ivec2((vec2(at) + 0.5) / vec2(textureSize(fine, 0)) * vec2(rough)), rough - 1);
}
vec4 seenAt(ivec2 at) {
  return at.y < ready ? texelFetch(fine, at, 0) : texelFetch(coarse, before(at), 0);
}
// The pixel that was looked at for a place of the fine picture.
vec2 askedAt(ivec2 at) {
  if (at.y < ready) return (vec2(at) + 0.5) / vec2(textureSize(fine, 0)) * size - 0.5;
  return (vec2(before(at)) + 0.5) / vec2(textureSize(coarse, 0)) * size - 0.5;
}
vec2 pixelOf(ivec2 at) { return (vec2(at) + 0.5) / vec2(textureSize(fine, 0)) * size - 0.5; }
// What is near, and in front of the tangent plane, takes light away: sixteen looks around, along a spiral.
float open(ivec2 at, vec4 seen, vec3 n) {
  const float REACH = 0.2;
  ivec2 grid = textureSize(fine, 0);
  vec3 here = seen.w * ray(askedAt(at));
  float wide = REACH * lens.x / seen.w * float(grid.x) / size.x, turn = 6.2831853 * fract(52.9829189 * fract(dot(vec2(at), vec2(0.06711056, 0.00583715))));
  float shut = 0.0;
  for (int k = 0; k < 16; k++) {
    float part = (float(k) + 0.5) / 16.0;
    ivec2 there = at + ivec2(round(wide * part * vec2(cos(turn + 7.5 * part), sin(turn + 7.5 * part))));
    if (any(lessThan(there, ivec2(0))) || any(greaterThanEqual(there, grid))) continue;
    float depth = seenAt(there).w;
    if (depth <= 0.0) continue;
    vec3 way = depth * ray(askedAt(there)) - here;
    float far = length(way) + 1e-6;
    shut += max(dot(n, way) / far - 0.08, 0.0) * max(1.0 - far / REACH, 0.0);
  }
  return clamp(1.0 - shut / 3.2, 0.15, 1.0);
}
// The own colour of what is seen; alpha is 1 where it has that in plain light too.
vec4 ownAt(ivec2 at) {
  if (at.y < ready) return texelFetch(fineColor, min(at, textureSize(fineColor, 0) - 1), 0);
  return texelFetch(coarseColor, min(before(at), textureSize(coarseColor, 0) - 1), 0);
}
vec3 shaded(ivec2 at, vec4 seen, vec4 own, vec3 along) {
  if (seen.w <= 0.0) return light(paper);
  vec3 n = seen.xyz;
  if (shading == 4) return light(own.rgb);
  if (shading == 1) return light(0.5 + 0.5 * n);
  if (dot(n, along) > 0.2) n = -n;
  else if (dot(n, along) > 0.0) n -= 2.0 * dot(n, along) * along;
  float clear = occluded ? open(at, seen, n) : 1.0;
  vec3 v = vec3(1.0, -1.0, -1.0) * (n * axes);
  if (shading == 0) return clear * matcap(v);
  float key = max(dot(v, normalize(vec3(-0.55, 0.70, 0.60))), 0.0);
  float fill = max(dot(v, normalize(vec3(0.75, 0.05, 0.65))), 0.0);
  vec3 ambient = mix(vec3(0.15, 0.14, 0.13), vec3(0.34, 0.36, 0.39), 0.5 + 0.5 * v.y);
  vec3 lamps = key * vec3(0.96, 0.93, 0.88) + fill * vec3(0.17, 0.18, 0.20);
  return light(shading == 3 || own.a > 0.5 ? own.rgb : clay) * (lamps * (0.4 + 0.6 * clear) + ambient * clear);
}
vec4 sectionAt(vec2 share) {
  ivec2 last = textureSize(section, 0) - 1;
  vec2 at = clamp(share, 0.0, 1.0) * vec2(last);
  ivec2 low = min(ivec2(at), last - 1);
  vec2 part = at - vec2(low);
  vec4 a = mix(texelFetch(section, low, 0), texelFetch(section, low + ivec2(1, 0), 0), part.x);
  vec4 b = mix(texelFetch(section, low + ivec2(0, 1), 0), texelFetch(section, low + ivec2(1, 1), 0), part.x);
  return mix(a, b, part.y);
}
float drawn(float far, float wide) { return 1.0 - smoothstep(0.5, 1.5, far / wide); }
// The plane over what is behind it: blue outside and orange inside, lines of equal distance, brighter in each band.
vec3 cutOver(vec3 behind, vec3 along) {
  float slope = along[across];
  float t = (place - eye[across]) / slope;
  vec3 there = eye + t * along;
  vec2 share = (vec2(there[(across + 1) % 3], there[(across + 2) % 3]) - extent.xy) / (extent.zw - extent.xy);
  if (slope == 0.0 || t <= 0.0 || any(lessThan(share, vec2(0.0))) || any(greaterThan(share, vec2(1.0)))) return behind;
  vec4 f = sectionAt(share);
  float wide = t / lens.x * inversesqrt(max(abs(slope), 0.05));
  vec3 color = f.r < 0.0 ? vec3(0.85, 0.47, 0.22) : vec3(0.27, 0.47, 0.74);
  float lines = drawn(abs(fract(f.r / spacing + 0.5) - 0.5) * spacing, wide);
  for (int k = 0; k < 3; k++) {
    if (bands[k] <= 0.0 || abs(f[k + 1]) >= bands[k]) break;
    color = mix(color, vec3(1.0, 0.97, 0.90), 0.3);
    lines = max(lines, drawn(bands[k] - abs(f[k + 1]), wide));
  }
  color *= 1.0 - 0.4 * lines;
  color = mix(color, vec3(0.05, 0.05, 0.07), drawn(abs(f.r), 1.5 * wide));
  return mix(behind, light(color), f.r < 0.0 ? 1.0 : 0.6);
}
void main() {
  vec2 at = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  ivec2 grid = textureSize(fine, 0);
  ivec2 many = max(ivec2(1), ivec2(round(vec2(grid) / size)));
  ivec2 first = ivec2(floor((at - 0.5) * vec2(grid) / size + (many == ivec2(1) ? 0.5 * vec2(grid) / size : vec2(0.0))));
  vec3 sum = vec3(0.0);
  for (int j = 0; j < many.y; j++) {
    for (int i = 0; i < many.x; i++) {
      ivec2 here = min(first + ivec2(i, j), grid - 1);
      vec4 seen = seenAt(here);
      sum += shaded(here, seen, ownAt(here), ray(pixelOf(here)));
    }
  }
  sum /= float(many.x * many.y);
  if (cut) sum = cutOver(sum, ray(at - 0.5));
  result = vec4(pow(clamp(sum, 0.0, 1.0), vec3(1.0 / 2.2)), 1.0);
}

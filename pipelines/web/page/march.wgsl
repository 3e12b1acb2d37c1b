#part gpu.sine
// The sine of angles in turns; see shaders.glsl.
fn sine(turns: vec4f) -> vec4f {
  let s = turns - round(turns);
  let t = min(abs(s), 0.5 - abs(s));
  let q = t * t;
  var p = 41.99998856 - 14.33702469 * q;
  p = -76.70366669 + p * q;
  p = 81.60520935 + p * q;
  p = -41.34170151 + p * q;
  p = 6.283185482 + p * q;
  return sign(s) * t * p;
}
fn cosine(turns: vec4f) -> vec4f {
  return sine(turns - round(turns) + 0.25);
}

#part gpu.lists
// Lists of rays hold twice as many entries as there is room for rays: those whose value is asked for, and from there on
// those whose jet is. How many there are stands in a slot of its own for each step.
struct Slot { count: atomic<u32>, step: u32 }
struct Filled { count: u32, step: u32 }
// Where a network is asked, and what it and those before it say: gradient and value. For values, `answer.x` is 1 where
// the ray goes on to level 0's root before any finer level is asked: it may where the value is below `point.w`. Then
// `answer.w` is level 0's alone.
struct Place { point: vec4f, answer: vec4f }

#part gpu.hull
// The mesh around the band: how far from the eye the nearest or the farthest of it is, for each pixel.
struct View { right: vec4f, down: vec4f, forward: vec4f, eye: vec4f, lens: vec4f, frame: vec4f }
@group(0) @binding(0) var<uniform> view: View;
struct Corner { @builtin(position) place: vec4f, @location(0) way: vec3f }
@vertex fn corner(@location(0) position: vec3f) -> Corner {
  let way = position - view.eye.xyz;
  let seen = vec3f(dot(way, view.right.xyz), dot(way, view.down.xyz), dot(way, view.forward.xyz));
  let pixel = view.lens.xy * seen.xy + view.lens.zw * seen.z;
  let place = 2.0 * (pixel + 0.5 * seen.z) / view.frame.xy - seen.z;
  let near = view.frame.z;
  let far = view.frame.w;
  return Corner(vec4f(place.x, -place.y, far * (seen.z - near) / (far - near), seen.z), way);
}
@fragment fn away(corner: Corner) -> @location(0) vec4f {
  return vec4f(length(corner.way), 0.0, 0.0, 1.0);
}

#part gpu.rays
struct Ray {
  direction: vec3f, t: f32,
  far: f32, low: f32, lowValue: f32, high: f32,
  highValue: f32, free: f32, gap: f32, boldness: f32,
  pixel: u32, stands: u32,
}
struct Frame {
  right: vec3f, width: u32,
  down: vec3f, rows: u32,
  forward: vec3f, first: u32,
  eye: vec3f, radius: f32,
  lens: vec4f,
  tolerance: f32, resolution: f32, accept: f32, pixel: f32,
  level: u32, within: u32, room: u32,
  unseen: f32,    // how much of a way to level 0's root may lie outside the ball before it
  clip: vec4f,   // x, y, z of the plane's axis, and where on it; 0, 0, 0 is none
  reach: vec4f,   // beyond which values of each level the surface cannot be
}
const NEVER = 1e30;
// What stands in `stands`.
const STARTED = 1u; // its first value is known
const INSIDE = 2u;  // it began inside, and looks for the way out
const HOPPED = 4u;  // it has looked at level 0's root, or past all bands
const EXACT = 8u;   // it asks for a jet

#part gpu.begin
// The rays that enter the mesh around the band, from where they do to where they leave it for good.
@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var nearest: texture_2d<f32>;
@group(0) @binding(2) var farthest: texture_2d<f32>;
@group(0) @binding(3) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(4) var<storage, read_write> places: array<Place>;
@group(0) @binding(5) var<storage, read_write> list: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots: array<Slot, 2>;
@compute @workgroup_size(64) fn begin(@builtin(global_invocation_id) id: vec3u) {
  let pixel = id.x;
  if (pixel >= frame.width * frame.rows) { return; }
  let at = vec2u(pixel % frame.width, pixel / frame.width);
  let back = textureLoad(farthest, at, 0).x;
  if (back <= 0.0) { return; }
  // A camera within the mesh sees its far side first: its rays begin at the eye.
  let front = select(textureLoad(nearest, at, 0).x - SLACK, 0.0, frame.within == 1u);
  let way = (vec2f(at + vec2u(0u, frame.first)) - frame.lens.zw) / frame.lens.xy;
  let direction = normalize(frame.right * way.x + frame.down * way.y + frame.forward);
  let b = dot(direction, frame.eye);
  // By the middle of the chord: the difference of two squares would lose the last digits of a far eye.
  let middle = frame.eye - b * direction;
  let half2 = frame.radius * frame.radius - dot(middle, middle);
  if (half2 <= 0.0) { return; }
  let chord = sqrt(half2);
  var start = max(max(0.0, -b - chord), front);
  if (any(frame.clip.xyz != vec3f(0.0))) { // what stands before a plane is cut away: rays begin on it
    let met = (frame.clip.w - dot(frame.eye, frame.clip.xyz)) / dot(direction, frame.clip.xyz);
    if (!(met > 0.0)) { return; }
    start = max(start, met);
  }
  let end = min(-b + chord, back + SLACK);
  if (start >= end) { return; }
  let i = atomicAdd(&slots[0].count, 1u);
  list[i] = i;
  rays[i] = Ray(direction, start, end, start, NEVER, NEVER, 0.0, 0.0, NEVER, BOLDNESS, pixel, 0u);
  places[i].point = vec4f(frame.eye + start * direction, 0.0);
}

#part gpu.march
// One look at the value of each ray that asked for one, or at its jet, and where to look next.
@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> rays: array<Ray>;
@group(0) @binding(2) var<storage, read_write> places: array<Place>;
@group(0) @binding(3) var<storage, read> list: array<u32>;
@group(0) @binding(4) var<storage, read> filled: array<Filled, 2>;
@group(0) @binding(5) var<storage, read_write> seen: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> nextList: array<u32>;
@group(0) @binding(7) var<storage, read_write> next: array<Slot, 2>;
fn band(size: f32) -> f32 {
  for (var j = 0u; j < frame.level; j++) {
    if (size >= frame.reach[j]) { return frame.reach[j]; }
  }
  return 0.0;
}
fn look(i: u32, step: u32) {
  var ray = rays[i];
  let answer = places[i].answer;
  let jet = JET == 1u;
  let t = ray.t;
  if ((ray.stands & STARTED) == 0u) { ray.stands |= STARTED | select(0u, INSIDE, answer.w < 0.0); }
  let sign = select(1.0, -1.0, (ray.stands & INSIDE) != 0u);
  let value = answer.w * sign;
  let size = abs(value);
  let hops = !jet && answer.x == 1.0;
  let delta = select(band(size), frame.reach.x, hops);
  let room = max(0.0, size - delta);
  let least = frame.resolution * exp2(floor(f32(step) / f32(PATIENCE)));
  let known = ray.lowValue < NEVER;
  let enclosed = ray.high < NEVER;
  let exact = dot(answer.xyz, ray.direction) * sign;
  let steepest = length(answer.xyz);
  var slope = -1.0; // head-on, before there are two values
  if (known) { slope = (value - ray.lowValue) / (t - ray.low); }
  if (jet) { slope = exact; }
  // A step of just so much leaves just this gap, but for rounding.
  let sound = enclosed || t - ray.low - ray.free - room <= 1.001 * ray.gap + ROUNDING;
  let steady = jet && abs(exact) > SHALLOW * steepest;
  let newton = select(0.0, -value / exact, steady);
  let steep = min(1.0, abs(slope));
  let near = sound && delta == 0.0
    && (size <= max(frame.tolerance * steep, FLOOR) || (steady && abs(newton) <= frame.accept * min(1.0, STEEP * steep)));
  // Finer levels may move the surface: level 0's value alone says where to look, and not that the ray is before it.
  let before = sound && value > 0.0 && !hops;
  let behind = sound && value <= 0.0;
  let wasWidth = ray.high - ray.low;
  let wasLow = ray.low;
  if (before) { ray.low = t; ray.lowValue = value; }
  if (behind) { ray.high = t; ray.highValue = value; }
  let closed = ray.high < NEVER;
  let width = ray.high - ray.low;
  var chord = ray.low + 0.5 * width;
  if (closed && ray.lowValue < NEVER) { chord = ray.low + width * ray.lowValue / (ray.lowValue - ray.highValue); }
  let pinned = closed && width <= frame.tolerance;
  if (jet && (near || pinned)) {
    let depth = t + clamp(newton, -frame.accept, frame.accept);
    seen[ray.pixel] = vec4f(answer.xyz / max(steepest, 1e-12), depth);
    return;
  }
  let hop = max(BAND_ENTRY * delta, least);
  if (before && !closed && !near && t + room + hop >= ray.far) { return; }
  let s = clamp(slope, -1.0, STEEPEST_RISE);
  var zero = NEVER;
  if (s < 0.0) { zero = value / -s; }
  var ahead = t;
  var stands = ray.stands & ~EXACT;
  var gap = hop;
  var asks = false; // for a jet
  if (near) {
    ahead = t + clamp(value / max(steep, 1e-6), -frame.tolerance, frame.tolerance);
    asks = true;
  } else if (pinned) {
    ahead = chord;
    asks = true;
  } else if (closed) {
    ahead = select(ray.low + 0.5 * width, chord, !enclosed || 2.0 * width <= wasWidth);
    let root = t + newton;
    if (steady && root > ray.low && root < ray.high) { ahead = root; }
  } else if (hops && sound) {
    ahead = t + zero;
    gap = frame.unseen;
    stands |= HOPPED;
  } else if (!before) {
    ahead = wasLow + ray.free; // the step left too wide a gap: it is taken back, and the next are less bold
  } else {
    let widest = ray.boldness * room * (1.0 + s) / (1.0 - s);
    ahead = t + room + max(widest, min(hop, zero - room));
  }
  if (!sound && known) { ray.boldness *= 0.5; }
  if (before) { ray.free = room; }
  ray.gap = gap;
  if (!jet && delta == 0.0) { stands |= HOPPED; }
  ray.t = min(ahead, ray.far);
  // Where all levels have had their say and the way left is short, the next look is at a jet.
  asks = asks || (delta == 0.0 && known && steep > 0.1 && max(abs(ray.t - t), zero) <= REACH * frame.accept);
  if (asks) { stands |= EXACT; }
  ray.stands = stands;
  rays[i] = ray;
  // Up to which value it may go on to level 0's root from there: it falls to it steeply, was not there before, and leaves
  // no wider gap on its way, from the last place before the surface, than a step into the band may.
  var hopping = 0.0;
  if (frame.level > 0u && !closed && (stands & (HOPPED | INSIDE)) == 0u) {
    let way = ray.t - ray.low;
    let most = ray.free + frame.unseen;
    hopping = max(0.0, min(min(ray.lowValue - STEEP_HOP * way, ray.lowValue * (1.0 - way / most)), most - way));
  }
  places[i].point = vec4f(frame.eye + ray.t * ray.direction, hopping);
  let kind = u32(asks);
  let k = atomicAdd(&next[kind].count, 1u);
  nextList[kind * frame.room + k] = i;
}
@compute @workgroup_size(64) fn march(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
  for (var k = id.x; k < filled[JET].count; k += 64u * groups.x) { look(list[JET * frame.room + k], filled[JET].step); }
}

#part gpu.network
// What stands around a network's kernel: which rays it is for, what becomes of what it finds, and who is asked next.
struct Gate {
  delta: f32, taper: f32, next: f32, deep: f32,  // the band of the level before; where finer levels have a say
  room: u32, level: u32, spare: vec2u,
}
@group(0) @binding(0) var<uniform> gate: Gate;
@group(0) @binding(1) var<storage, read> weights: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> places: array<Place>;
@group(0) @binding(3) var<storage, read> list: array<u32>;
@group(0) @binding(4) var<storage, read> filled: array<Filled, 2>;
@group(0) @binding(5) var<storage, read_write> nextList: array<u32>;
@group(0) @binding(6) var<storage, read_write> next: array<Slot, 2>;
@group(0) @binding(7) var<storage, read_write> scratch: array<vec4f>;
fn ray(k: u32) -> u32 {
  return list[JET * gate.room + k];
}
fn told(i: u32, found: vec4f) {
  if (COLOR) {
    places[i].answer = found;
    return;
  }
  var all = found;
  if (gate.level > 0u) {
    let before = places[i].answer;
    var open = 1.0;
    var slope = 0.0;
    if (gate.taper > 0.0) {
      let u = clamp((abs(before.w) / gate.delta - (1.0 - gate.taper)) / gate.taper, 0.0, 1.0);
      open = 1.0 - u * u * (3.0 - 2.0 * u);
      slope = -6.0 * u * (1.0 - u) * sign(before.w) / (gate.delta * gate.taper);
    }
    all = vec4f(0.0, 0.0, 0.0, before.w + open * found.w);
    if (JET == 1u) { all = vec4f((1.0 + slope * found.w) * before.xyz + open * found.xyz, all.w); }
  }
  var goes = abs(all.w) < gate.next;
  if (JET == 0u && gate.level == 0u && goes) {
    let hops = all.w > gate.deep && all.w < places[i].point.w;
    all.x = select(0.0, 1.0, hops);
    goes = !hops;
  }
  places[i].answer = all;
  if (!goes) { return; }
  let k = atomicAdd(&next[JET].count, 1u);
  nextList[JET * gate.room + k] = i;
}

// Networks in WGSL: one kernel takes points through a whole network, and for a jet back again.
//
// An invocation has four points, whose activations lie in memory of its own, eight neurons at a time in registers; all
// invocations read the same weights at the same time. No barriers, so that a workgroup never waits for its slowest.

const LANES = 32, OWN = 4;       // invocations of a workgroup, points of each
const MOST_SCRATCH = 2 ** 26;    // bytes for activations
const MOST_GROUPS = 256;

// Eighths of a network's width, in fours.
const quadsOf = (width) => 2 * Math.ceil(width / 8);

// Bytes of activations that a workgroup wants.
const scratchOf = ({ width, depth }) => (depth + 1) * quadsOf(width) * OWN * LANES * 16;

// Weights as the kernels read them, four neurons at a time: for each sine layer its columns, then its bias; for each but
// the first its rows as the sweep back wants them; and the outputs. Returns numbers and where each begins, in fours.
function packNetwork(layers) {
  const width = layers[0].bias.length, quads = quadsOf(width), depth = layers.length - 1;
  const parts = [], starts = { columns: [], bias: [], rows: [] };
  let size = 0;
  const add = (rows, at) => {
    const numbers = new Float32Array(4 * quads * rows);
    for (let row = 0; row < rows; row++) for (let n = 0; n < width; n++) numbers[4 * quads * row + n] = at(row, n);
    parts.push(numbers);
    size += quads * rows;
    return size - quads * rows;
  };
  // Rows of zeros up to the padded width: what the kernels multiply there must not be another matrix.
  const square = (at) => add(4 * quads, (row, n) => (row < width ? at(row, n) : 0));
  layers.slice(0, depth).forEach(({ weight, bias }, index) => {
    starts.columns.push(index ? square((column, n) => weight[n * width + column]) : add(3, (column, n) => weight[3 * n + column]));
    starts.bias.push(add(1, (_, n) => bias[n]));
    starts.rows.push(index ? square((row, n) => weight[row * width + n]) : 0);
  });
  starts.output = add(layers[depth].bias.length, (row, n) => layers[depth].weight[row * width + n]);
  const all = new Float32Array(4 * size);
  parts.reduce((at, part) => { all.set(part, at); return at + part.length; }, 0);
  return { numbers: all, starts, width, depth, outputs: Array.from(layers[depth].bias), bias: layers[0].bias, rate: layers[0].rate };
}

// The kernel of a packed network: kind 'value', 'jet', or 'color' (three outputs instead of one).
function networkKernel({ starts, width, depth, outputs }, kind, parts) {
  const quads = quadsOf(width), jet = kind === 'jet', color = kind === 'color';
  const points = [0, 1, 2, 3], part = 'xyzw';
  const number = (value) => { const text = Math.fround(value).toPrecision(9); return /[.e]/.test(text) ? text : `${text}.0`; };
  const each = (line) => points.map((p) => line(p)).join('');
  const last = depth - 1;
  // What becomes of the phases z of neurons n of a layer.
  const finish = (layer, held, n, z) => {
    const lines = [`let b=weights[${starts.bias[layer]}u+${n}];${each((p) => `${z}${p}+=b;`)}`];
    if (layer === last) {
      const channels = color ? [0, 1, 2] : [0];
      channels.forEach((c) => lines.push(`let v${c}=weights[${starts.output + c * quads}u+${n}];`));
      each((p) => lines.push(`{let s=sine(${z}${p});${channels.map((c) => `found${p}.${color ? part[c] : 'w'}+=dot(v${c},s);`).join('')}}`));
      if (jet) lines.push(each((p) => `${z}${p}=v0*TURN*cosine(${z}${p});`), depth === 1 ? descend(n, z) : each((p) => `scratch[at(${held}u,${n},${p}u)]=${z}${p};`));
    } else {
      if (jet) lines.push(each((p) => `scratch[at(${2 + layer}u,${n},${p}u)]=TURN*cosine(${z}${p});`));
      lines.push(each((p) => `scratch[at(${held}u,${n},${p}u)]=sine(${z}${p});`));
    }
    return `{${lines.join('\n')}}`;
  };
  // The end of the sweep back: what neurons n of the first layer add to the gradient.
  const descend = (n, s) => ['x', 'y', 'z'].map((c, i) => `{let w=weights[${starts.columns[0] + i * quads}u+${n}];${each((p) => `found${p}.${c}+=dot(w,${s}${p});`)}}`).join('');
  // A product of a matrix with what lies in a slot, eight rows at a time.
  const product = (start, from, then) => `for(var n=0u;n<${quads}u;n+=2u){
    ${each((p) => `var y${p}=vec4f(0.0);var z${p}=vec4f(0.0);`)}
    for(var k=0u;k<${quads}u;k++){
    ${each((p) => `let h${p}=scratch[at(${from}u,k,${p}u)];`)}
    let w=${start}u+4u*k*${quads}u+n;
    let a=mat4x4f(weights[w],weights[w+${quads}u],weights[w+${2 * quads}u],weights[w+${3 * quads}u]);
    let c=mat4x4f(weights[w+1u],weights[w+${quads + 1}u],weights[w+${2 * quads + 1}u],weights[w+${3 * quads + 1}u]);
    ${each((p) => `y${p}+=a*h${p};z${p}+=c*h${p};`)}}
    ${then('n', 'y')}${then('(n+1u)', 'z')}}`;
  const columns = [0, 1, 2].map((c) => `let w${c}=weights[${starts.columns[0] + c * quads}u+n];`).join('');
  const lines = [`for(var n=0u;n<${quads}u;n++){${columns}
    ${each((p) => `var y${p}=w0*x${p}.x+w1*x${p}.y+w2*x${p}.z;`)}
    ${finish(0, 0, 'n', 'y')}}`];
  let held = 0;
  for (let layer = 1; layer < depth; layer++) {
    const into = 1 - held;
    lines.push(product(starts.columns[layer], held, (n, z) => finish(layer, into, n, z)));
    held = into;
  }
  if (jet) {
    for (let layer = last; layer > 0; layer--) {
      const into = 1 - held;
      lines.push(product(starts.rows[layer], held, (n, s) => `${each((p) => `${s}${p}*=scratch[at(${1 + layer}u,${n},${p}u)];`)}
        ${layer === 1 ? descend(n, s) : each((p) => `scratch[at(${into}u,${n},${p}u)]=${s}${p};`)}`));
      held = into;
    }
  }
  const begin = color ? `vec4f(${outputs.map(number).join(',')},1.0)` : `vec4f(0.0,0.0,0.0,${number(outputs[0])})`;
  return `${parts.get('gpu.sine')}${parts.get('gpu.lists')}const JET=${Number(jet)}u;const COLOR=${color};const TURN=6.283185307;
    ${parts.get('gpu.network')}
    var<private> base:u32;
    fn at(slot:u32,n:u32,p:u32)->u32{return base+((slot*${quads}u+n)*${OWN}u+p)*${LANES}u;}
    @compute @workgroup_size(${LANES}) fn network(@builtin(local_invocation_index) lane:u32,@builtin(workgroup_id) group:vec3u,@builtin(num_workgroups) groups:vec3u){
    base=group.x*${scratchOf({ width, depth }) / 16}u+lane;
    let count=filled[JET].count;
    for(var first=(group.x*${LANES}u+lane)*${OWN}u;first<count;first+=groups.x*${LANES * OWN}u){
    ${each((p) => `let i${p}=ray(min(first+${p}u,count-1u));let x${p}=places[i${p}].point;var found${p}=${begin};`)}
    ${lines.join('\n')}
    ${each((p) => `if(first+${p}u<count){told(i${p},found${p});}`)}}}`;
}

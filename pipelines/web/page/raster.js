// Triangles and points by the adapter's own rasteriser: the mesh around a band, and clouds and meshes that are shown.

const CLAY = [0.77, 0.72, 0.66]; // of what has no colours

// Float textures that are drawn into together, with a depth buffer.
class Target {
  constructor(gl, width, height, count) {
    Object.assign(this, { gl, width, height, depth: gl.createRenderbuffer(), buffer: gl.createFramebuffer() });
    this.textures = Array.from({ length: count }, () => texture2d(gl, width, height));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.buffer);
    this.textures.forEach((texture, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(this.textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
  }

  close() {
    const { gl } = this;
    this.textures.forEach((texture) => gl.deleteTexture(texture));
    gl.deleteFramebuffer(this.buffer);
    gl.deleteRenderbuffer(this.depth);
  }

  read(index, width, rows) {
    const { gl } = this, numbers = new Float32Array(4 * width * rows);
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + index);
    gl.readPixels(0, 0, width, rows, gl.RGBA, gl.FLOAT, numbers);
    return numbers;
  }
}

// A program that draws from a camera into a target of `count` textures.
class Raster {
  constructor(gl, parts, fragment, count, defines = []) {
    Object.assign(this, { gl, count, program: compile(gl, parts, 'corner', fragment, defines), held: [], target: null });
  }

  close() {
    this.held.forEach((held) => this.gl.deleteVertexArray(held));
    this.gl.deleteProgram(this.program.program);
    this.target?.close();
  }

  // A vertex array of attributes {name: [numbers, type]}; `each` 1 has one row for each instance. Integers count from 0 to 1.
  filled(attributes, faces, each = 0) {
    const { gl, program } = this, held = gl.createVertexArray();
    const fill = (kind, numbers) => {
      gl.bindBuffer(kind, gl.createBuffer());
      gl.bufferData(kind, numbers, gl.STATIC_DRAW);
    };
    gl.bindVertexArray(held);
    for (const [name, [numbers, type]] of Object.entries(attributes)) {
      const place = gl.getAttribLocation(program.program, name);
      if (!numbers || place < 0) continue;
      fill(gl.ARRAY_BUFFER, numbers);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, type, true, 0, 0);
      gl.vertexAttribDivisor(place, each);
    }
    if (faces) fill(gl.ELEMENT_ARRAY_BUFFER, faces);
    gl.bindVertexArray(null);
    this.held.push(held);
    return held;
  }

  // Everything that follows is drawn for rows [first, first + rows) of the camera's picture.
  begin(camera, first, rows) {
    const { gl, program } = this, { width } = camera;
    if (this.target?.width !== width || this.target.height < rows) {
      this.target?.close();
      this.target = new Target(gl, width, rows, this.count);
    }
    const far = Math.hypot(...camera.eye) + 3, near = far / 4096;
    gl.useProgram(program.program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.buffer);
    gl.viewport(0, 0, width, rows);
    gl.uniform3f(program.at('eye'), ...camera.eye);
    gl.uniformMatrix3fv(program.at('axes'), false, [...camera.right, ...camera.down, ...camera.forward]);
    gl.uniform4f(program.at('lens'), camera.fx, camera.fy, camera.cx, camera.cy - first);
    gl.uniform4f(program.at('frame'), width, rows, near, far);
    gl.enable(gl.DEPTH_TEST);
    for (let index = 0; index < this.count; index++) gl.clearBufferfv(gl.COLOR, index, [0, 0, 0, 0]);
  }

  // What was drawn: the numbers of each texture.
  end(width, rows) {
    const { gl } = this;
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(null);
    return this.target.textures.map((_, index) => this.target.read(index, width, rows));
  }
}

// The mesh around the band: where the ray of each pixel enters it first and leaves it last.
class Hull extends Raster {
  constructor(gl, parts, arrays, header) {
    super(gl, parts, 'depth', 1);
    const { places, faces } = shellArrays(header, arrays);
    this.corners = faces.length;
    this.mesh = this.filled({ position: [places, gl.FLOAT] }, faces);
  }

  // For each pixel of rows [first, first + rows): r = nearest front face, g = farthest back face; 0 where there is none.
  crossings(camera, first, rows) {
    const { gl } = this;
    this.begin(camera, first, rows);
    gl.bindVertexArray(this.mesh);
    gl.enable(gl.CULL_FACE);
    gl.frontFace(gl.CW); // y points down in the target
    for (const [face, test, clear, red] of [[gl.BACK, gl.LESS, 1, true], [gl.FRONT, gl.GREATER, 0, false]]) {
      gl.colorMask(red, !red, false, false);
      gl.clearBufferfv(gl.DEPTH, 0, [clear]);
      gl.cullFace(face);
      gl.depthFunc(test);
      gl.drawElements(gl.TRIANGLES, this.corners, gl.UNSIGNED_INT, 0);
    }
    gl.colorMask(true, true, true, true);
    gl.disable(gl.CULL_FACE);
    return this.end(camera.width, rows)[0];
  }
}

// Clouds and meshes: normal and depth of what each pixel sees of them, as a tracer gives it, and its colour.
class Shapes extends Raster {
  constructor(gl, parts, { header, arrays }) {
    super(gl, parts, 'shape', 2, ['SHAPE']);
    this.shapes = header.shapes.map((shape, index) => {
      const numbers = (name) => arrays.get(`shape${index}.${name}`), faces = numbers('faces'), normals = numbers('normals');
      const attributes = {
        position: [numbers('vertices'), gl.UNSIGNED_SHORT], normal: [normals && Int8Array.from(normals), gl.BYTE], color: [numbers('colors'), gl.UNSIGNED_BYTE],
      };
      return { ...shape, mesh: this.filled(attributes, faces, shape.kind === 'points' ? 1 : 0) };
    });
    this.slack = Math.max(...header.shapes.map(({ size }) => size)); // points lie in a surface: half of each is before it
  }

  get kind() {
    return 'WebGL 2';
  }

  draw(camera, { first = 0, rows = camera.height, clip = null, hidden = [] }) {
    const { gl, program } = this, place = (name) => gl.getAttribLocation(program.program, name);
    this.begin(camera, first, rows);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.depthFunc(gl.LESS);
    gl.uniform1i(program.at('across'), clip ? clip.axis : -1);
    gl.uniform1f(program.at('place'), clip ? clip.at : 0);
    for (const { name, kind, count, size, low, high, mesh } of this.shapes) {
      if (hidden.includes(name)) continue;
      gl.bindVertexArray(mesh);
      gl.vertexAttrib3f(place('normal'), 0, 0, 0); // where there are none of its own
      gl.vertexAttrib4f(place('color'), ...CLAY, 0);
      gl.uniform3f(program.at('low'), ...low);
      gl.uniform3f(program.at('extent'), ...high.map((end, c) => end - low[c]));
      gl.uniform1f(program.at('radius'), size / 2);
      if (kind === 'points') gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      else gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_INT, 0);
    }
    const [seen, color] = this.end(camera.width, rows);
    return { seen, color };
  }
}

// Of two pictures of one camera what is nearer in each pixel; the second may be `slack` behind the first.
function nearer(one, other, slack) {
  const seen = one.seen.slice(), color = one.color.length ? one.color.slice() : new Float32Array(seen.length);
  for (let at = 0; at < seen.length; at += 4) {
    const depth = other.seen[at + 3];
    if (!depth || (seen[at + 3] && depth > seen[at + 3] + slack)) continue;
    seen.set(other.seen.subarray(at, at + 4), at);
    color.set(other.color.subarray(at, at + 4), at);
  }
  return { seen, color };
}

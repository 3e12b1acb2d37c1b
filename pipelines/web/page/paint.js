// From what was traced to colours on the canvas: two pictures, a coarse one that is whole and a fine one that grows over it.

const PAPERS = {
  dark: [0.086, 0.094, 0.114],
  light: [0.957, 0.949, 0.933],
};

class Paint {
  constructor(gl, parts) {
    this.gl = gl;
    this.shade = compile(gl, parts, 'plane', 'shade');
    this.coarse = this.fine = null;
    this.ready = 0; // rows of the fine one
    this.blank = texture2d(gl, 2, 2);
  }

  held(name, { width, height }, colored) {
    const { gl } = this, held = this[name];
    if (held && held.width === width && held.height === height && held.colored === colored) return held;
    if (held && this.coarse !== this.fine) for (const texture of [held.texture, held.color]) gl.deleteTexture(texture);
    // Where no colours are asked for, one texel stands for them.
    const color = texture2d(gl, colored ? width : 1, colored ? height : 1);
    this[name] = { width, height, colored, texture: texture2d(gl, width, height), color };
    return this[name];
  }

  write({ texture, color }, { seen, color: own }, width, first, rows) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0);
    for (const [into, numbers] of [[texture, seen], [color, own]]) {
      if (!numbers.length) continue;
      gl.bindTexture(gl.TEXTURE_2D, into);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, width, rows, gl.RGBA, gl.FLOAT, numbers);
    }
  }

  // A picture that is whole at once.
  whole(grid, made) {
    this.write(this.held('coarse', grid, made.color.length > 0), made, grid.width, 0, grid.height);
    this.fine ??= this.coarse;
    this.ready = 0;
  }

  // A finer one, which comes in strips.
  begin(grid, colored) {
    this.held('fine', grid, colored);
    this.ready = 0;
  }

  add(grid, made, first, rows) {
    this.write(this.fine, made, grid.width, first, rows);
    this.ready = first + rows;
  }

  complete() {
    [this.coarse, this.fine] = [this.fine, this.coarse];
    this.ready = 0;
  }

  // What is there, onto the canvas, as `look` wants it: theme, shading, occlusion and section.
  present(camera, { theme, shading, occlusion, section }) {
    const { gl, shade } = this;
    gl.useProgram(shade.program);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, camera.width, camera.height);
    const planes = {
      fine: this.fine.texture, coarse: this.coarse.texture, fineColor: this.fine.color, coarseColor: this.coarse.color,
      section: section.texture ?? this.blank,
    };
    Object.entries(planes).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(shade.at(name), unit);
    });
    gl.uniform1i(shade.at('ready'), this.ready);
    gl.uniform1i(shade.at('shading'), shading);
    gl.uniform1i(shade.at('occluded'), occlusion);
    gl.uniform2f(shade.at('size'), camera.width, camera.height);
    gl.uniformMatrix3fv(shade.at('axes'), false, [...camera.right, ...camera.down, ...camera.forward]);
    gl.uniform4f(shade.at('lens'), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform3f(shade.at('paper'), ...PAPERS[theme]);
    gl.uniform3f(shade.at('clay'), ...CLAY);
    gl.uniform3f(shade.at('eye'), ...camera.eye);
    gl.uniform1i(shade.at('cut'), section.texture ? 1 : 0);
    if (section.texture) {
      gl.uniform1i(shade.at('across'), section.axis);
      gl.uniform1f(shade.at('place'), section.at);
      gl.uniform4f(shade.at('extent'), ...section.extent);
      gl.uniform3f(shade.at('bands'), ...section.bands);
      gl.uniform1f(shade.at('spacing'), section.spacing);
    }
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

// A camera in OpenCV's convention, as `mplicits render` has it: x right, y down, z forward, the centre of the upper left
// pixel at (0, 0). Azimuth counts counter-clockwise around the up axis from the front: +z for y up, -y for z up.

class Orbit {
  constructor(view) {
    this.view = view;
    this.reset();
  }

  reset() {
    const { middle, distance, azimuth, elevation } = this.view;
    Object.assign(this, { middle: [...middle], distance, azimuth, elevation });
  }

  axes() {
    const a = (this.azimuth * Math.PI) / 180, e = (this.elevation * Math.PI) / 180;
    const side = Math.sin(a) * Math.cos(e), front = Math.cos(a) * Math.cos(e), up = Math.sin(e);
    const [right, forward] = this.view.up === 'y'
      ? [[Math.cos(a), 0, -Math.sin(a)], [-side, -up, -front]]
      : [[Math.cos(a), Math.sin(a), 0], [-side, front, -up]];
    const down = [
      forward[1] * right[2] - forward[2] * right[1],
      forward[2] * right[0] - forward[0] * right[2],
      forward[0] * right[1] - forward[1] * right[0],
    ];
    return { right, down, forward };
  }

  // For a picture of so many pixels; the angle of view is that of the shorter side.
  camera(width, height) {
    const axes = this.axes();
    const focal = Math.min(width, height) / 2 / Math.tan((this.view.fov * Math.PI) / 360);
    const eye = this.middle.map((part, c) => part - this.distance * axes.forward[c]);
    return { eye, ...axes, fx: focal, fy: focal, cx: (width - 1) / 2, cy: (height - 1) / 2, width, height };
  }

  turn(across, upwards) {
    this.azimuth = (this.azimuth - across) % 360;
    this.elevation = Math.min(90, Math.max(-90, this.elevation + upwards));
  }

  // By shares of the picture's shorter side.
  pan(across, upwards) {
    const { right, down } = this.axes();
    const length = 2 * this.distance * Math.tan((this.view.fov * Math.PI) / 360);
    for (let c = 0; c < 3; c++) this.middle[c] += length * (-across * right[c] - upwards * down[c]);
  }

  zoom(factor) {
    this.distance = Math.min(40, Math.max(0.05, this.distance / factor));
  }
}

// A camera for a picture of other pixels: corners stay where they are.
function resized(camera, width, height) {
  const sx = width / camera.width, sy = height / camera.height;
  return {
    ...camera, width, height, fx: camera.fx * sx, fy: camera.fy * sy, cx: (camera.cx + 0.5) * sx - 0.5, cy: (camera.cy + 0.5) * sy - 0.5,
  };
}

/** A camera in OpenCV's convention, in the field's units: x to the right, y down, z forward. */
export interface Camera {
  eye: [number, number, number];
  right: [number, number, number];
  down: [number, number, number];
  forward: [number, number, number];
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
}

/** Evaluations of each network (those of colours last), passes of the adapter, and bytes read back. */
export interface Counts {
  values: number[];
  jets: number[];
  passes: number;
  read: number;
}

/** A picture, row by row from the upper left: normal and depth of each pixel, depth 0 where nothing is. */
export interface Picture {
  width: number;
  height: number;
  seen: Float32Array;
  color: Float32Array;
  milliseconds: number;
  counts: Counts;
}

/** What a picture shows: the finest level is wanted by default; `precision` is of depths, in the field's units. */
export interface Wanted {
  camera: Camera;
  level?: number;
  normalLevel?: number;
  precision?: number | null;
  colored?: boolean;
  /** Names of clouds and meshes that are left out; "surface" is the field. */
  hidden?: string[];
}

/** One ray of the last picture. */
export interface Hit {
  position: [number, number, number];
  normal: [number, number, number];
  depth: number;
}

export interface Renderer {
  pick(x: number, y: number): Promise<Hit | null>;
  /** Values of a level at points x, y, z, x, y, …, in the field's units. */
  values(points: Float32Array, level: number): Promise<Float32Array>;
}

/**
 * `<mplicits-field src="field.bin" camera="40,15" level="2">`. It sends "load" when the field is there, and "error", with a
 * message for people, when it is not.
 */
export class MplicitsField extends HTMLElement {
  /** Of the field: its levels, bands, and `unit` and `center`, which bring its units into those of the input. */
  readonly header: Record<string, unknown> | null;
  readonly renderer: Renderer | null;
  render(wanted: Wanted): Promise<Picture>;
  bench(wanted?: { size?: number; frames?: number; level?: number }): Promise<Record<string, unknown>>;
  turntable(wanted?: { frames?: number; side?: number; rate?: number }): Promise<{ blob: Blob; ending: string }>;
}

declare global {
  interface HTMLElementTagNameMap {
    'mplicits-field': MplicitsField;
  }
}

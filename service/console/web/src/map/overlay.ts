// Lines, marks and labels over the cloud, drawn in 2D so that they stay sharp at every zoom.
import { Vector3, type Camera } from 'three';
import type { Vector } from '../contract';
import type { LocalFrame } from './local_frame';

export type Point = readonly [number, number];

export interface Ink {
  line: string;
  fill?: string;
  width?: number;
  dash?: number[];
}

/** A surface in CSS pixels onto which map coordinates are projected. */
export class Overlay {
  readonly context: CanvasRenderingContext2D;
  #frame: LocalFrame | null = null;
  #camera: Camera | null = null;
  #width = 1;
  #height = 1;
  #taken: { x: number; y: number; width: number }[] = [];
  readonly #scratch = new Vector3();

  constructor(readonly canvas: HTMLCanvasElement) {
    const context = canvas.getContext('2d');
    if (context === null) throw new Error('This browser has no 2D canvas.');
    this.context = context;
  }

  begin(frame: LocalFrame, camera: Camera, width: number, height: number, ratio: number): void {
    this.#frame = frame;
    this.#camera = camera;
    this.#width = width;
    this.#height = height;
    this.#taken = [];
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.context.clearRect(0, 0, width, height);
    this.context.lineJoin = 'round';
    this.context.lineCap = 'round';
  }

  /** Position of a map point on the surface; null behind the camera. */
  at(x: number, y: number, z: number): Point | null {
    if (this.#frame === null || this.#camera === null) return null;
    const point = this.#scratch.set(this.#frame.x(x), this.#frame.y(y), this.#frame.z(z));
    point.applyMatrix4(this.#camera.matrixWorldInverse);
    if ('isPerspectiveCamera' in this.#camera && point.z > -0.5) return null;
    point.applyMatrix4(this.#camera.projectionMatrix);
    return [(0.5 + point.x / 2) * this.#width, (0.5 - point.y / 2) * this.#height];
  }

  /** A line through points of the map; parts behind the camera are left out. */
  path(points: Vector[], ink: Ink, closed = false): void {
    const context = this.context;
    context.beginPath();
    let drawing = false;
    let whole = true;
    for (const point of points) {
      const at = this.at(point.x, point.y, point.z);
      if (at === null) whole = false;
      else if (drawing) context.lineTo(...at);
      else context.moveTo(...at);
      drawing = at !== null;
    }
    if (closed && whole) context.closePath();
    this.#ink(ink, closed && whole);
  }

  dot(at: Point, radius: number, ink: Ink): void {
    this.context.beginPath();
    this.context.arc(at[0], at[1], radius, 0, 2 * Math.PI);
    this.#ink(ink, true);
  }

  /** A label, unless it would cover another one. */
  label(text: string, at: Point, colour: string, halo: string, bold = false): void {
    const context = this.context;
    context.font = `${bold ? 600 : 500} 12px system-ui, sans-serif`;
    const width = context.measureText(text).width;
    const [x, y] = at;
    if (x < -width || x > this.#width + width || y < 0 || y > this.#height) return;
    const hidden = this.#taken.some(
      (other) => Math.abs(other.x - x) < (other.width + width) / 2 + 6 && Math.abs(other.y - y) < 16,
    );
    if (hidden) return;
    this.#taken.push({ x, y, width });
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    context.strokeStyle = halo;
    context.lineWidth = 4;
    context.setLineDash([]);
    context.strokeText(text, x, y);
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  #ink(ink: Ink, fills: boolean): void {
    const context = this.context;
    if (fills && ink.fill !== undefined) {
      context.fillStyle = ink.fill;
      context.fill();
    }
    context.setLineDash(ink.dash ?? []);
    context.lineWidth = ink.width ?? 1.5;
    context.strokeStyle = ink.line;
    context.stroke();
  }
}

// The binary formats of /v1/maps/{map}/cloud, /v1/maps/{map}/places and of the points in an explanation; little-endian.
import type { Explanation, Vector } from './contract';

export interface Cloud {
  count: number;
  origin: Vector;
  step: Vector;
  /** x, y, z in steps, and how upright the surface is (0 flat, 65535 a wall): four values per point. */
  records: Uint16Array<ArrayBuffer>;
}

export interface Places {
  count: number;
  /** x, y, z in map metres, three values per place. */
  positions: Float64Array;
}

export interface QueryPoints {
  count: number;
  origin: Vector;
  xyz: Float32Array;
  rgb: Uint8Array;
}

const CLOUD_HEADER = 56;
const PLACES_HEADER = 32;
const PLACE_BYTES = 20;
const POINT_BYTES = 16;

function view(buffer: ArrayBuffer, magic: string): DataView {
  const found = new TextDecoder('latin1').decode(buffer.slice(0, 4));
  if (found !== magic) throw new Error(`the service sent ${JSON.stringify(found)} where ${magic} was expected; reload the page`);
  return new DataView(buffer);
}

function vectorAt(data: DataView, offset: number): Vector {
  return {
    x: data.getFloat64(offset, true),
    y: data.getFloat64(offset + 8, true),
    z: data.getFloat64(offset + 16, true),
  };
}

export function cloudFrom(buffer: ArrayBuffer): Cloud {
  const data = view(buffer, 'SFC1');
  const count = data.getUint32(4, true);
  const records = new Uint16Array(buffer, CLOUD_HEADER, 4 * count); // all platforms with a browser are little-endian
  return { count, origin: vectorAt(data, 8), step: vectorAt(data, 32), records };
}

export function placesFrom(buffer: ArrayBuffer): Places {
  const data = view(buffer, 'SFP1');
  const count = data.getUint32(4, true);
  const origin = vectorAt(data, 8);
  const positions = new Float64Array(3 * count);
  for (let k = 0; k < count; k++) {
    const at = PLACES_HEADER + PLACE_BYTES * k;
    positions[3 * k] = origin.x + data.getFloat32(at, true);
    positions[3 * k + 1] = origin.y + data.getFloat32(at + 4, true);
    positions[3 * k + 2] = origin.z + data.getFloat32(at + 8, true);
  }
  return { count, positions };
}

export function queryPointsFrom(points: Explanation['points']): QueryPoints {
  const bytes = bytesFrom(points.data);
  const data = new DataView(bytes.buffer);
  const xyz = new Float32Array(3 * points.count);
  const rgb = new Uint8Array(3 * points.count);
  for (let k = 0; k < points.count; k++) {
    for (let axis = 0; axis < 3; axis++) {
      xyz[3 * k + axis] = data.getFloat32(POINT_BYTES * k + 4 * axis, true);
      rgb[3 * k + axis] = data.getUint8(POINT_BYTES * k + 12 + axis);
    }
  }
  return { count: points.count, origin: points.origin, xyz, rgb };
}

export function bytesFrom(base64: string): Uint8Array<ArrayBuffer> {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}

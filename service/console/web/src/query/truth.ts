// The ground truth of a query, if a file gives it, and the error of an answer.
import type { Answer, Truth } from '../contract';

/**
 * JSON with `position` and `heading_deg`, or a line of TUM (timestamp x y z qx qy qz qw, camera to map); of several lines the one
 * whose number is in the image's name.
 */
export function truthFrom(text: string, imageName: string): Truth {
  if (text.trimStart().startsWith('{')) {
    const read = JSON.parse(text) as Partial<Truth>;
    const { position } = read;
    if (typeof position?.x !== 'number' || typeof position.y !== 'number') {
      throw new Error('The ground truth has no "position" with x, y and z in map metres.');
    }
    return { position: { x: position.x, y: position.y, z: position.z }, heading_deg: read.heading_deg ?? null };
  }
  const lines = text.split('\n').filter((line) => line.trim() !== '' && !line.startsWith('#'));
  const number = Number(/(\d+)\.\w+$/.exec(imageName)?.[1] ?? '0');
  const line = lines.length === 1 ? lines[0] : lines[number];
  const values = (line ?? '').trim().split(/\s+/).map(Number);
  if (values.length !== 8 || values.some(Number.isNaN)) {
    throw new Error('The ground truth is neither JSON with "position" nor TUM: timestamp x y z qx qy qz qw.');
  }
  const [, x = 0, y = 0, z = 0, qx = 0, qy = 0, qz = 0, qw = 0] = values;
  // The camera looks along its z axis: the third column of the rotation.
  const heading = Math.atan2(2 * (qy * qz - qx * qw), 2 * (qx * qz + qy * qw));
  return { position: { x, y, z }, heading_deg: (180 * heading) / Math.PI };
}

export interface ErrorOfAnswer {
  metres: number;
  degrees: number | null;
}

/** Horizontal error and heading error; null without a pose. */
export function errorOf(answer: Answer, truth: Truth): ErrorOfAnswer | null {
  if (answer.pose === null) return null;
  const { position, heading_deg } = answer.pose;
  const turn = truth.heading_deg === null ? null : Math.abs(((heading_deg - truth.heading_deg + 540) % 360) - 180);
  return { metres: Math.hypot(position.x - truth.position.x, position.y - truth.position.y), degrees: turn };
}

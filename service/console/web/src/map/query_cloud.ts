// The query's points at the pose of the answer, in the colours of the image.
import { BufferAttribute, BufferGeometry, Points, PointsMaterial } from 'three';
import type { QueryPoints } from '../binary';
import type { LocalFrame } from './local_frame';

export class QueryCloud {
  readonly object: Points;
  readonly #material: PointsMaterial;

  constructor(points: QueryPoints, frame: LocalFrame, pixelRatio: number) {
    const geometry = new BufferGeometry();
    geometry.setAttribute('position', new BufferAttribute(points.xyz, 3));
    geometry.setAttribute('color', new BufferAttribute(points.rgb, 3, true));
    this.#material = new PointsMaterial({ size: 3 * pixelRatio, sizeAttenuation: false, vertexColors: true });
    this.object = new Points(geometry, this.#material);
    this.object.position.set(frame.x(points.origin.x), frame.y(points.origin.y), frame.z(points.origin.z) + 0.05);
    this.object.frustumCulled = false;
    this.object.renderOrder = 1;
  }

  dispose(): void {
    this.object.geometry.dispose();
    this.#material.dispose();
  }
}

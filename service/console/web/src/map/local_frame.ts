// Metres of the map frame less one origin for each map: what a graphics card's 32-bit numbers hold to the millimetre.
import type { Vector } from '../contract';

export class LocalFrame {
  constructor(readonly origin: Vector) {}

  x(mapX: number): number {
    return mapX - this.origin.x;
  }

  y(mapY: number): number {
    return mapY - this.origin.y;
  }

  z(mapZ: number): number {
    return mapZ - this.origin.z;
  }
}

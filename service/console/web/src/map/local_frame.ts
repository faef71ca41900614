// Map coordinates minus one origin per map, so that the 32-bit numbers of a graphics card are exact to the millimetre.
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

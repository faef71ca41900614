// The map over the cloud: streets with their names, the survey's track, the coverage.
import type { Places } from '../binary';
import type { StreetFeature, Vector } from '../contract';
import type { Overlay } from './overlay';
import type { Palette } from './palette';

const MOST_DOTS = 4000;

interface Street {
  name: string;
  rings: Vector[][];
  middle: Vector;
}

export class GroundLayer {
  readonly #streets: Street[];
  readonly #places: Places;
  /** How far from a place the map can answer, metres; 0 draws no coverage. */
  reachM = 0;

  constructor(streets: StreetFeature[], places: Places, groundZ: number) {
    this.#places = places;
    this.#streets = streets.map((street) => {
      const polygons = street.geometry.type === 'Polygon' ? [street.geometry.coordinates] : street.geometry.coordinates;
      const rings = polygons.flat().map((ring) => ring.map(([x = 0, y = 0]) => ({ x, y, z: groundZ })));
      return { name: street.properties.name, rings, middle: middleOf(rings) };
    });
  }

  draw(overlay: Overlay, palette: Palette, metrePx: number): void {
    if (this.reachM > 0) this.#drawCoverage(overlay, palette, metrePx);
    for (const street of this.#streets) {
      for (const ring of street.rings) overlay.path(ring, { line: palette.street, fill: palette.streetFill, width: 1 }, true);
    }
    this.#drawTrack(overlay, palette, metrePx);
  }

  /** Drawn last, so that labels of the answer have priority. */
  drawNames(overlay: Overlay, palette: Palette): void {
    for (const street of this.#streets) {
      const at = overlay.at(street.middle.x, street.middle.y, street.middle.z);
      if (at !== null) overlay.label(street.name, at, palette.name, palette.halo);
    }
  }

  #drawTrack(overlay: Overlay, palette: Palette, metrePx: number): void {
    const radius = Math.min(2.2, Math.max(0.9, 0.12 * metrePx));
    overlay.context.fillStyle = palette.track;
    for (const at of this.#seenPlaces(overlay)) overlay.context.fillRect(at[0] - radius, at[1] - radius, 2 * radius, 2 * radius);
  }

  #drawCoverage(overlay: Overlay, palette: Palette, metrePx: number): void {
    const context = overlay.context;
    context.beginPath();
    for (const at of this.#seenPlaces(overlay)) {
      context.moveTo(at[0] + this.reachM * metrePx, at[1]);
      context.arc(at[0], at[1], this.reachM * metrePx, 0, 2 * Math.PI);
    }
    context.fillStyle = palette.coverage;
    context.fill();
  }

  *#seenPlaces(overlay: Overlay): Generator<readonly [number, number]> {
    const { count, positions } = this.#places;
    const every = Math.ceil(count / MOST_DOTS);
    for (let k = 0; k < count; k += every) {
      const at = overlay.at(positions[3 * k] ?? 0, positions[3 * k + 1] ?? 0, positions[3 * k + 2] ?? 0);
      if (at !== null) yield at;
    }
  }
}

/** Middle of the largest ring's box: good enough for a name. */
function middleOf(rings: Vector[][]): Vector {
  const largest = rings.reduce((best, ring) => (ring.length > best.length ? ring : best), rings[0] ?? []);
  const xs = largest.map((point) => point.x);
  const ys = largest.map((point) => point.y);
  return {
    x: (Math.min(...xs) + Math.max(...xs)) / 2,
    y: (Math.min(...ys) + Math.max(...ys)) / 2,
    z: largest[0]?.z ?? 0,
  };
}

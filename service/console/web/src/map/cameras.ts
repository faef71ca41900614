// Two cameras: orthographic from above, and perspective.
import { OrthographicCamera, PerspectiveCamera, Vector3 } from 'three';
import { MapControls } from 'three/examples/jsm/controls/MapControls.js';

export type Mode = 'above' | 'around';
const REACH = 20_000;

export class Cameras {
  readonly above = new OrthographicCamera(-1, 1, 1, -1, -REACH, REACH);
  readonly around = new PerspectiveCamera(55, 1, 0.5, REACH);
  readonly #controls: Record<Mode, MapControls>;
  #mode: Mode = 'above';
  #width = 1;
  #height = 1;

  constructor(surface: HTMLElement, moved: () => void) {
    this.around.up.set(0, 0, 1);
    this.#controls = { above: new MapControls(this.above, surface), around: new MapControls(this.around, surface) };
    this.#controls.above.enableRotate = false;
    this.#controls.above.screenSpacePanning = true;
    this.#controls.around.screenSpacePanning = false;
    this.#controls.around.maxPolarAngle = 0.495 * Math.PI;
    for (const controls of Object.values(this.#controls)) {
      controls.enableDamping = false;
      controls.zoomToCursor = true;
      controls.addEventListener('change', moved);
    }
    this.mode = 'above';
  }

  get mode(): Mode {
    return this.#mode;
  }

  set mode(mode: Mode) {
    this.#mode = mode;
    for (const [name, controls] of Object.entries(this.#controls)) controls.enabled = name === mode;
  }

  /** Whether dragging moves the map. A tool such as the prior may need dragging itself. */
  set movable(movable: boolean) {
    this.#controls[this.#mode].enabled = movable;
  }

  get active(): OrthographicCamera | PerspectiveCamera {
    return this.#mode === 'above' ? this.above : this.around;
  }

  /** CSS pixels per metre: everywhere from above, at a distance of one metre in perspective. */
  get metrePx(): number {
    if (this.#mode === 'above') return (this.above.zoom * this.#height) / (this.above.top - this.above.bottom);
    return this.#height / (2 * Math.tan((this.around.fov * Math.PI) / 360));
  }

  resize(width: number, height: number): void {
    this.#width = width;
    this.#height = height;
    const half = this.above.top;
    this.above.left = (-half * width) / height;
    this.above.right = (half * width) / height;
    this.around.aspect = width / height;
    this.above.updateProjectionMatrix();
    this.around.updateProjectionMatrix();
  }

  /** Show a part of the map from above: its centre and the least half width, metres. */
  show(x: number, y: number, radius: number): void {
    const half = radius * Math.max(1, this.#height / this.#width);
    this.above.top = half;
    this.above.bottom = -half;
    this.above.zoom = 1;
    this.#controls.above.target.set(x, y, 0);
    this.above.position.set(x, y, 100);
    this.resize(this.#width, this.#height);
    this.#controls.above.update();
  }

  /** View along the heading of a camera, from behind and above it. */
  follow(at: Vector3, headingRad: number): void {
    const back = new Vector3(-Math.cos(headingRad), -Math.sin(headingRad), 0);
    this.#controls.around.target.copy(at).addScaledVector(back, -12);
    this.around.position.copy(at).addScaledVector(back, 16);
    this.around.position.z += 11;
    this.#controls.around.update();
  }

  /** Centre of the view. */
  get target(): Vector3 {
    return this.#controls[this.#mode].target;
  }

  zoomBy(factor: number): void {
    if (this.#mode === 'above') {
      this.above.zoom *= factor;
      this.above.updateProjectionMatrix();
    } else {
      this.around.position.lerp(this.#controls.around.target, 1 - 1 / factor);
    }
    this.#controls[this.#mode].update();
  }

  /** Shares of the height of the view, to the right and up. */
  panBy(right: number, up: number): void {
    const camera = this.active;
    const metres =
      this.#mode === 'above'
        ? this.#height / this.metrePx
        : camera.position.distanceTo(this.#controls.around.target);
    const heading = this.#mode === 'above' ? Math.PI / 2 : this.#heading();
    const step = new Vector3(
      metres * (right * Math.sin(heading) + up * Math.cos(heading)),
      metres * (-right * Math.cos(heading) + up * Math.sin(heading)),
      0,
    );
    camera.position.add(step);
    this.#controls[this.#mode].target.add(step);
    this.#controls[this.#mode].update();
  }

  #heading(): number {
    const along = new Vector3().subVectors(this.#controls.around.target, this.around.position);
    return Math.atan2(along.y, along.x);
  }
}

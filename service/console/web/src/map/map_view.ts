// The map on the screen. It is drawn only after a change.
import { Color, Plane, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from 'three';
import type { Cloud, Places, QueryPoints } from '../binary';
import type { StreetFeature } from '../contract';
import { element } from '../element';
import { AnswerLayer, type Shown } from './answer_layer';
import { Cameras, type Mode } from './cameras';
import { CloudPoints, type Shade } from './cloud_points';
import { FrameBudget } from './frame_budget';
import { GroundLayer } from './ground_layer';
import { LocalFrame } from './local_frame';
import { Overlay } from './overlay';
import { PALETTES } from './palette';
import { PriorLayer } from './prior_layer';
import { QueryCloud } from './query_cloud';

/** Approximate height of the survey's LiDAR above the ground, m. Colours show the height above that ground. */
const LIDAR_M = 1.8;
const REST_MS = 180;
const ANSWER_M = 55;

export class MapView {
  readonly element: HTMLElement;
  readonly prior = new PriorLayer();
  onPriorDrawn: () => void = () => undefined;
  readonly #renderer: WebGLRenderer;
  readonly #scene = new Scene();
  readonly #cameras: Cameras;
  readonly #overlay: Overlay;
  readonly #answer = new AnswerLayer();
  readonly #budget = new FrameBudget();
  readonly #surface: HTMLCanvasElement;
  #frame = new LocalFrame({ x: 0, y: 0, z: 0 });
  #groundZ = 0;
  #extent = { x: 0, y: 0, radius: 100 };
  #ground: GroundLayer | null = null;
  #cloud: CloudPoints | null = null;
  #query: QueryCloud | null = null;
  #shade: Shade = 'light';
  #frameRequest = 0;
  #moving = false;
  #rest = 0;
  #drawsPrior = false;
  #drawsAll = false;

  constructor() {
    this.#surface = element('canvas', { class: 'cloud', 'aria-hidden': 'true' });
    const lines = element('canvas', { class: 'lines', 'aria-hidden': 'true' });
    this.element = element(
      'div',
      {
        class: 'map-surface',
        tabindex: '0',
        role: 'application',
        'aria-label': 'Map. Arrow keys pan, plus and minus zoom, 0 shows all, 3 switches between the view from above and 3D.',
      },
      this.#surface,
      lines,
    );
    this.#renderer = new WebGLRenderer({ canvas: this.#surface, antialias: false, powerPreference: 'high-performance' });
    this.#overlay = new Overlay(lines);
    this.#cameras = new Cameras(this.element, () => {
      this.#moved();
    });
    new ResizeObserver(() => {
      this.#resize();
    }).observe(this.element);
    this.element.addEventListener('keydown', (event) => {
      this.#pressed(event);
    });
    this.#listenForPrior();
  }

  get mode(): Mode {
    return this.#cameras.mode;
  }

  set mode(mode: Mode) {
    const { x, y } = this.#cameras.target;
    this.#cameras.mode = mode;
    if (mode === 'around' && this.#answer.shown === null) this.#cameras.follow(new Vector3(x, y, 0), 0.9);
    this.changed();
  }

  set shade(shade: Shade) {
    this.#shade = shade;
    this.#scene.background = new Color(PALETTES[shade].paper);
    this.#cloud?.shade(shade);
    this.changed();
  }

  set reachM(reachM: number) {
    if (this.#ground) this.#ground.reachM = reachM;
    this.changed();
  }

  /** Whether dragging draws a prior instead of moving the map. */
  set drawsPrior(draws: boolean) {
    this.#drawsPrior = draws;
    if (draws) this.mode = 'above';
    this.#cameras.movable = !draws;
    this.element.classList.toggle('draws', draws);
  }

  /** Whether every point is drawn, regardless of the time. */
  set drawsAll(draws: boolean) {
    this.#drawsAll = draws;
    this.changed();
  }

  get pointCount(): number {
    return this.#cloud?.count ?? 0;
  }

  /** Show streets and track. The cloud follows when it is loaded. */
  setMap(streets: StreetFeature[], places: Places): void {
    const box = boxOf(places);
    this.#frame = new LocalFrame({ x: box.x, y: box.y, z: box.z });
    this.#groundZ = box.z - LIDAR_M;
    this.#extent = { x: 0, y: 0, radius: box.radius };
    this.#ground = new GroundLayer(streets, places, this.#groundZ);
    this.#answer.shown = null;
    this.#drop();
    this.showAll();
  }

  setCloud(cloud: Cloud): void {
    this.#cloud?.dispose();
    if (this.#cloud) this.#scene.remove(this.#cloud.object);
    this.#cloud = new CloudPoints(cloud, this.#frame, this.#groundZ);
    this.#cloud.shade(this.#shade);
    this.#scene.add(this.#cloud.object);
    this.changed();
  }

  showAnswer(shown: Shown, points: QueryPoints): void {
    this.#answer.shown = shown;
    this.#dropQuery();
    const { pose, hypotheses, spread } = shown.answer;
    if (pose !== null) {
      // Points at an unconfirmed position would suggest that the images were taken there.
      this.#query = new QueryCloud(points, this.#frame, this.#renderer.getPixelRatio());
      this.#scene.add(this.#query.object);
    }
    const poses = pose === null ? hypotheses.map((each) => each.pose) : [pose];
    const positions = poses.map((each) => each.position);
    if (positions.length === 0 && spread !== null) positions.push(spread.mean);
    this.#centre(positions);
    const first = poses[0];
    if (first === undefined) {
      this.#moved();
      return;
    }
    const { position, heading_deg } = first;
    const at = new Vector3(this.#frame.x(position.x), this.#frame.y(position.y), this.#frame.z(position.z));
    this.#cameras.follow(at, (heading_deg * Math.PI) / 180);
    this.#moved();
  }

  clearAnswer(): void {
    this.#answer.shown = null;
    this.#dropQuery();
    this.changed();
  }

  showAll(): void {
    this.#cameras.show(this.#extent.x, this.#extent.y, this.#extent.radius);
    this.changed();
  }

  /** Centre one position, as from a list of answers. */
  showAt(x: number, y: number): void {
    this.#centre([{ x, y }]);
    this.changed();
  }

  zoomBy(factor: number): void {
    this.#cameras.zoomBy(factor);
  }

  /** Draw in the next frame, once for all changes until then. */
  changed(): void {
    if (this.#frameRequest === 0) {
      this.#frameRequest = requestAnimationFrame(() => {
        this.#frameRequest = 0;
        this.#draw();
      });
    }
  }

  #centre(positions: { x: number; y: number }[]): void {
    const xs = positions.map((each) => this.#frame.x(each.x));
    const ys = positions.map((each) => this.#frame.y(each.y));
    const [left, right] = [Math.min(...xs), Math.max(...xs)];
    const [low, high] = [Math.min(...ys), Math.max(...ys)];
    const radius = Math.max(ANSWER_M, 0.7 * Math.max(right - left, high - low));
    this.#cameras.show((left + right) / 2, (low + high) / 2, radius);
  }

  #moved(): void {
    this.#moving = true;
    window.clearTimeout(this.#rest);
    this.#rest = window.setTimeout(() => {
      this.#moving = false;
      this.changed();
    }, REST_MS);
    this.changed();
  }

  #draw(): void {
    const cameras = this.#cameras;
    const ratio = this.#renderer.getPixelRatio();
    const palette = PALETTES[this.#shade];
    const began = performance.now();
    if (this.#cloud) {
      const affordable = this.#moving ? this.#budget.points : this.#budget.pointsAtRest;
      this.#cloud.limit(this.#drawsAll ? Infinity : affordable);
      this.#cloud.scale(cameras.metrePx * ratio, ratio);
    }
    this.#renderer.render(this.#scene, cameras.active);
    const size = this.#renderer.getSize(new Vector2());
    const metrePx = cameras.metrePx / (cameras.mode === 'above' ? 1 : Math.max(1, cameras.active.position.distanceTo(cameras.target)));
    this.#overlay.begin(this.#frame, cameras.active, size.x, size.y, ratio);
    this.#ground?.draw(this.#overlay, palette, metrePx);
    this.prior.draw(this.#overlay, palette, this.#groundZ);
    this.#answer.draw(this.#overlay, palette, metrePx);
    this.#answer.drawNames(this.#overlay, palette);
    this.#ground?.drawNames(this.#overlay, palette);
    this.element.dataset['frames'] = String(Number(this.element.dataset['frames'] ?? 0) + 1);
    if (this.#moving && this.#cloud && !this.#drawsAll) this.#measure(began, Math.min(this.#budget.points, this.#cloud.count));
  }

  /** The graphics card still works after the call, so the start of the next frame ends the measurement. */
  #measure(began: number, drawn: number): void {
    requestAnimationFrame(() => {
      this.#budget.took(performance.now() - began, drawn);
    });
  }

  #resize(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width === 0 || height === 0) return;
    const ratio = Math.min(2, window.devicePixelRatio);
    this.#renderer.setPixelRatio(ratio);
    this.#renderer.setSize(width, height, false);
    this.#overlay.canvas.width = Math.round(width * ratio);
    this.#overlay.canvas.height = Math.round(height * ratio);
    this.#cameras.resize(width, height);
    this.#frameRequest ||= requestAnimationFrame(() => {
      this.#frameRequest = 0;
      this.#draw();
    });
  }

  #pressed(event: KeyboardEvent): void {
    const step = 0.12;
    const actions: Record<string, () => void> = {
      ArrowLeft: () => { this.#cameras.panBy(-step, 0); },
      ArrowRight: () => { this.#cameras.panBy(step, 0); },
      ArrowUp: () => { this.#cameras.panBy(0, step); },
      ArrowDown: () => { this.#cameras.panBy(0, -step); },
      '+': () => { this.zoomBy(1.3); },
      '=': () => { this.zoomBy(1.3); },
      '-': () => { this.zoomBy(1 / 1.3); },
      '0': () => { this.showAll(); },
      '3': () => { this.element.dispatchEvent(new CustomEvent('turn')); },
    };
    const action = actions[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  }

  #listenForPrior(): void {
    this.element.addEventListener('pointerdown', (event) => {
      if (!this.#drawsPrior || event.button !== 0) return;
      this.element.setPointerCapture(event.pointerId);
      const at = this.#groundAt(event);
      if (at) this.prior.begin(at.x, at.y);
      this.changed();
    });
    this.element.addEventListener('pointermove', (event) => {
      if (!this.#drawsPrior || !this.element.hasPointerCapture(event.pointerId)) return;
      const at = this.#groundAt(event);
      if (at) this.prior.drag(at.x, at.y);
      this.changed();
    });
    this.element.addEventListener('pointerup', (event) => {
      if (!this.#drawsPrior || !this.element.hasPointerCapture(event.pointerId)) return;
      this.element.releasePointerCapture(event.pointerId);
      this.onPriorDrawn();
    });
  }

  /** The point of the ground under the pointer, map metres. */
  #groundAt(event: PointerEvent): { x: number; y: number } | null {
    const box = this.element.getBoundingClientRect();
    const at = new Vector2(
      (2 * (event.clientX - box.left)) / box.width - 1,
      1 - (2 * (event.clientY - box.top)) / box.height,
    );
    const ray = new Raycaster();
    ray.setFromCamera(at, this.#cameras.active);
    const ground = new Plane(new Vector3(0, 0, 1), -this.#frame.z(this.#groundZ));
    const found = this.#cameras.mode === 'above' ? ray.ray.origin : ray.ray.intersectPlane(ground, new Vector3());
    return found === null ? null : { x: found.x + this.#frame.origin.x, y: found.y + this.#frame.origin.y };
  }

  #drop(): void {
    if (this.#cloud) {
      this.#scene.remove(this.#cloud.object);
      this.#cloud.dispose();
      this.#cloud = null;
    }
    this.#dropQuery();
  }

  #dropQuery(): void {
    if (this.#query === null) return;
    this.#scene.remove(this.#query.object);
    this.#query.dispose();
    this.#query = null;
  }
}

function boxOf(places: Places): { x: number; y: number; z: number; radius: number } {
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  const heights: number[] = [];
  for (let k = 0; k < places.count; k++) {
    for (let axis = 0; axis < 2; axis++) {
      const value = places.positions[3 * k + axis] ?? 0;
      low[axis] = Math.min(low[axis] ?? value, value);
      high[axis] = Math.max(high[axis] ?? value, value);
    }
    heights.push(places.positions[3 * k + 2] ?? 0);
  }
  const [left = 0, bottom = 0] = low;
  const [right = 0, top = 0] = high;
  heights.sort((a, b) => a - b);
  return {
    x: (left + right) / 2,
    y: (bottom + top) / 2,
    z: heights[Math.floor(heights.length / 2)] ?? 0,
    radius: 1.12 * Math.max(30, (top - bottom) / 2, ((right - left) / 2) * 0.75),
  };
}

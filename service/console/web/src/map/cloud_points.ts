// The cloud as one draw call, coloured by height. While the map moves, only its first part is drawn, which is a thinner cloud.
import { BufferGeometry, Color, InterleavedBuffer, InterleavedBufferAttribute, Points, ShaderMaterial } from 'three';
import type { Cloud } from '../binary';
import type { LocalFrame } from './local_frame';

/** Heights above the ground of the track (m) of the colours below. */
export const HEIGHTS_M = [0, 2, 6, 14, 30];
export const COLOURS = {
  light: ['#c9c5b8', '#8fb3a7', '#3f8f95', '#2f5f8f', '#3b2f63'],
  dark: ['#3a4147', '#3f6f72', '#4fa3a0', '#a9d18e', '#f4e7a1'],
} as const;
export type Shade = keyof typeof COLOURS;

const VERTEX = /* glsl */ `
  attribute float upright;
  uniform float groundZ, metrePx, smallestPx, largestPx;
  uniform float heights[5];
  uniform vec3 colours[5];
  uniform float shading;
  varying vec3 colour;
  void main() {
    vec4 local = modelMatrix * vec4(position, 1.0);
    vec4 seen = viewMatrix * local;
    gl_Position = projectionMatrix * seen;
    float depth = projectionMatrix[2][3] < 0.0 ? max(0.5, -seen.z) : 1.0;
    gl_PointSize = clamp(metrePx / depth, smallestPx, largestPx);
    float height = local.z - groundZ;
    colour = colours[0];
    for (int k = 0; k < 4; k++) colour = mix(colour, colours[k + 1], smoothstep(heights[k], heights[k + 1], height));
    colour *= 1.0 - shading * upright;
  }`;

const FRAGMENT = /* glsl */ `
  varying vec3 colour;
  void main() { gl_FragColor = vec4(colour, 1.0); }`;

export class CloudPoints {
  readonly object: Points;
  readonly #material: ShaderMaterial;
  readonly #count: number;

  constructor(cloud: Cloud, frame: LocalFrame, groundZ: number) {
    const geometry = new BufferGeometry();
    const records = new InterleavedBuffer(cloud.records, 4);
    geometry.setAttribute('position', new InterleavedBufferAttribute(records, 3, 0));
    geometry.setAttribute('upright', new InterleavedBufferAttribute(records, 1, 3, true));
    this.#count = cloud.count;
    this.#material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        groundZ: { value: frame.z(groundZ) },
        metrePx: { value: 1 },
        smallestPx: { value: 1 },
        largestPx: { value: 6 },
        shading: { value: 0.25 },
        heights: { value: HEIGHTS_M },
        colours: { value: COLOURS.light.map((each) => new Color().setStyle(each, '')) },
      },
    });
    this.object = new Points(geometry, this.#material);
    this.object.position.set(frame.x(cloud.origin.x), frame.y(cloud.origin.y), frame.z(cloud.origin.z));
    this.object.scale.set(cloud.step.x, cloud.step.y, cloud.step.z);
    this.object.frustumCulled = false; // the camera always looks at some of it
  }

  get count(): number {
    return this.#count;
  }

  /** Limit the number of drawn points. */
  limit(points: number): void {
    this.object.geometry.setDrawRange(0, Math.min(this.#count, points));
  }

  shade(shade: Shade): void {
    const uniforms = this.#material.uniforms;
    if (uniforms['colours']) uniforms['colours'].value = COLOURS[shade].map((each) => new Color().setStyle(each, ''));
    if (uniforms['shading']) uniforms['shading'].value = shade === 'light' ? 0.3 : 0.15;
  }

  /** Pixels per metre: at a distance of one metre, or everywhere without perspective. */
  scale(metrePx: number, pixelRatio: number): void {
    const uniforms = this.#material.uniforms;
    if (uniforms['metrePx']) uniforms['metrePx'].value = 0.4 * metrePx;
    if (uniforms['smallestPx']) uniforms['smallestPx'].value = pixelRatio;
    if (uniforms['largestPx']) uniforms['largestPx'].value = 7 * pixelRatio;
  }

  dispose(): void {
    this.object.geometry.dispose();
    this.#material.dispose();
  }
}

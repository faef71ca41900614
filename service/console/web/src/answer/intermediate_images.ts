// The intermediate images of an answer. A slider lays the map's depth over the query's depth.
import { bytesFrom } from '../binary';
import type { Explanation } from '../contract';
import { element } from '../element';

export class IntermediateImages {
  readonly element = element('div', { class: 'images' });
  #addresses: string[] = [];

  show(rgb: Blob, explanation: Explanation): void {
    for (const address of this.#addresses) URL.revokeObjectURL(address);
    this.#addresses = [];
    const { depth, fused, view, map_depth: mapDepth } = explanation;
    this.element.replaceChildren(
      element(
        'div',
        { class: 'pair' },
        this.#figure('RGB', this.#address(rgb), 'RGB image of the query'),
        this.#figure('Depth', this.#png(depth), 'Depth image of the query, near red, far blue'),
      ),
      this.#figure('Fused 2.5D image: input of the encoder', this.#png(fused), 'Range instead of intensity, with the colour of the image', 'cells'),
      view === null ? '' : this.#figure('Map view of the most similar place (n1)', this.#png(view), 'Map rendered at the most similar place', 'cells'),
      mapDepth === null ? '' : this.#overlay(depth, mapDepth, explanation.answer.pose === null ? 'the best guess, not confirmed' : 'the answer'),
    );
  }

  #overlay(depth: string, mapDepth: string, where: string): HTMLElement {
    const over = element('img', { src: this.#png(mapDepth), alt: `Depth of the map, rendered at ${where}`, class: 'over' });
    const slider = element('input', { type: 'range', min: '0', max: '100', value: '50', 'aria-label': 'Share of the map’s depth over the query’s depth' });
    const place = (): void => {
      over.style.clipPath = `inset(0 0 0 ${slider.value}%)`;
      line.style.left = `${slider.value}%`;
    };
    const line = element('span', { class: 'line', 'aria-hidden': 'true' });
    slider.addEventListener('input', place);
    place();
    return element(
      'figure',
      { class: 'compare' },
      element('div', { class: 'stack' }, element('img', { src: this.#png(depth), alt: 'Depth image of the query' }), over, line, slider),
      element('figcaption', {}, element('span', {}, '◂ query’s depth'), element('span', {}, `map’s depth at ${where} ▸`)),
    );
  }

  #figure(name: string, address: string, alt: string, kind = ''): HTMLElement {
    return element('figure', { class: kind }, element('img', { src: address, alt }), element('figcaption', {}, name));
  }

  #png(base64: string): string {
    return this.#address(new Blob([bytesFrom(base64)], { type: 'image/png' }));
  }

  #address(blob: Blob): string {
    const address = URL.createObjectURL(blob);
    this.#addresses.push(address);
    return address;
  }
}

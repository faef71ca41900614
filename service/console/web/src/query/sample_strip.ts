// Sample pairs of the map: a click sends one.
import type { SamplePair } from '../contract';
import { element } from '../element';
import type { Service } from '../service';
import type { Query } from './query';

export class SampleStrip {
  readonly element = element('div', { class: 'strip', role: 'list', 'aria-label': 'Sample pairs' });
  readonly #images = new Map<string, Promise<Blob>>();

  constructor(
    readonly service: Service,
    readonly chosen: (name: string, query: Promise<Query>) => void,
  ) {}

  show(samples: SamplePair[]): void {
    this.#images.clear();
    this.element.replaceChildren(...samples.map((sample) => element('div', { role: 'listitem' }, this.#card(sample))));
  }

  mark(name: string | null): void {
    for (const card of this.element.querySelectorAll('button')) {
      card.setAttribute('aria-pressed', String(card.dataset['sample'] === name));
    }
  }

  #card(sample: SamplePair): HTMLButtonElement {
    const image = element('img', { alt: '', width: '112', height: '84', loading: 'lazy' });
    const card = element(
      'button',
      { type: 'button', class: 'sample', 'aria-pressed': 'false', 'aria-label': `Send sample ${sample.name}` },
      image,
      element('span', {}, sample.name),
    );
    card.dataset['sample'] = sample.name;
    void this.#image(sample.rgb).then((blob) => {
      image.src = URL.createObjectURL(blob);
    }, () => {
      card.classList.add('broken'); // sending the sample shows why
    });
    card.addEventListener('click', () => {
      this.mark(sample.name);
      this.chosen(sample.name, this.#query(sample));
    });
    return card;
  }

  async #query(sample: SamplePair): Promise<Query> {
    const [rgb, depth] = await Promise.all([this.#image(sample.rgb), this.#image(sample.depth)]);
    const named = (part: string, blob: Blob): { name: string; blob: Blob } => ({
      name: `${part}.${{ 'image/jpeg': 'jpg', 'image/png': 'png', 'image/webp': 'webp', 'image/tiff': 'tiff' }[blob.type] ?? 'npy'}`,
      blob,
    });
    return {
      rgb: named('rgb', rgb),
      depth: named('depth', depth),
      request: JSON.stringify(sample.request, null, 1),
      truth: sample.truth,
    };
  }

  #image(address: string): Promise<Blob> {
    let image = this.#images.get(address);
    if (image === undefined) {
      image = this.service.sampleImage(address);
      image.catch(() => this.#images.delete(address)); // the next click tries again
      this.#images.set(address, image);
    }
    return image;
  }
}

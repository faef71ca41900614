// Pairs that lie ready beside the map: a click asks.
import type { SamplePair } from '../contract';
import { element } from '../element';
import type { Service } from '../service';
import type { Question } from './question';

export class SampleStrip {
  readonly element = element('div', { class: 'strip', role: 'list', 'aria-label': 'Sample pairs' });
  readonly #pictures = new Map<string, Promise<Blob>>();

  constructor(
    readonly service: Service,
    readonly chosen: (name: string, question: Promise<Question>) => void,
  ) {}

  show(samples: SamplePair[]): void {
    this.#pictures.clear();
    this.element.replaceChildren(...samples.map((sample) => element('div', { role: 'listitem' }, this.#card(sample))));
  }

  mark(name: string | null): void {
    for (const card of this.element.querySelectorAll('button')) {
      card.setAttribute('aria-pressed', String(card.dataset['sample'] === name));
    }
  }

  #card(sample: SamplePair): HTMLButtonElement {
    const picture = element('img', { alt: '', width: '112', height: '84', loading: 'lazy' });
    const card = element(
      'button',
      { type: 'button', class: 'sample', 'aria-pressed': 'false', 'aria-label': `Ask sample ${sample.name}` },
      picture,
      element('span', {}, sample.name),
    );
    card.dataset['sample'] = sample.name;
    void this.#picture(sample.rgb).then((blob) => {
      picture.src = URL.createObjectURL(blob);
    }, () => {
      card.classList.add('broken'); // asking it says why
    });
    card.addEventListener('click', () => {
      this.mark(sample.name);
      this.chosen(sample.name, this.#question(sample));
    });
    return card;
  }

  async #question(sample: SamplePair): Promise<Question> {
    const [rgb, depth] = await Promise.all([this.#picture(sample.rgb), this.#picture(sample.depth)]);
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

  #picture(address: string): Promise<Blob> {
    let picture = this.#pictures.get(address);
    if (picture === undefined) {
      picture = this.service.samplePicture(address);
      picture.catch(() => this.#pictures.delete(address)); // the next click tries again
      this.#pictures.set(address, picture);
    }
    return picture;
  }
}

// The inputs of a query: images, request, prior.
import type { Prior } from '../contract';
import { button, element } from '../element';
import type { Service } from '../service';
import { asCurl, asPython } from './copy_as';
import { sorted } from './files';
import { PriorFields } from './prior_fields';
import { NO_QUERY, requestFrom, type NamedBlob, type Query } from './query';
import type { Offer } from './samples_of_map';
import { SampleStrip } from './sample_strip';

export interface QueryActions {
  send: (query: Query) => void;
  drawsPrior: (draws: boolean) => void;
  priorChanged: (prior: Prior | null) => void;
  /** Name of the shown map. */
  map: () => string | null;
  prior: () => Prior | null;
  failed: (error: unknown) => void;
}

export class QueryPanel {
  readonly element: HTMLElement;
  readonly strip: SampleStrip;
  readonly prior: PriorFields;
  readonly #samplesHead = element('p', { class: 'hint' });
  readonly #chosen = element('ul', { class: 'chosen' });
  readonly #request = element('textarea', { id: 'request', rows: '5', spellcheck: 'false', placeholder: '{"camera": {"width": 640, "height": 480, "fx": …}}' });
  readonly #send: HTMLButtonElement;
  readonly #copied = element('span', { class: 'hint', role: 'status' });
  #query: Query = NO_QUERY;
  /** Name of the chosen sample. */
  #sample: string | null = null;

  constructor(service: Service, readonly actions: QueryActions) {
    this.strip = new SampleStrip(service, (name, loading) => {
      loading.then((query) => {
        this.#sample = name;
        this.#take(query);
        actions.send(query);
      }, actions.failed);
    });
    this.prior = new PriorFields(actions.drawsPrior, actions.priorChanged);
    this.#send = button('Localize', () => {
      actions.send(this.#query);
    }, { class: 'primary', disabled: true });
    this.#request.addEventListener('input', () => {
      this.#query = { ...this.#query, request: this.#request.value };
      this.#refresh();
    });
    const copy = (label: string, made: typeof asCurl): HTMLButtonElement =>
      button(label, () => {
        this.#copy(() => made(this.#query, requestFrom(this.#query, null, actions.prior()), service.base, service.key !== ''));
      }, { class: 'small' });
    this.element = element(
      'div',
      { class: 'panel' },
      element('section', {}, element('h2', {}, 'Sample pairs'), this.#samplesHead, this.strip.element),
      element('section', {}, element('h2', {}, 'Your images'), this.#dropZone(), this.#chosen),
      element('section', {}, element('h2', {}, element('label', { for: 'request' }, 'Request')), this.#request),
      element('details', {}, element('summary', {}, 'Prior: rough position of the camera'), this.prior.element),
      element('div', { class: 'row sticky' }, this.#send, copy('Copy as curl', asCurl), copy('as Python', asPython)),
      this.#copied,
    );
    this.#refresh();
  }

  /** Show the sample pairs of the shown map, and name the other maps that have samples. */
  offer({ samples, otherMaps }: Offer): void {
    const none = otherMaps.length > 0 ? 'There are no samples of this map.' : 'There are no samples. Run `streetfix demo`, or set STREETFIX_SAMPLES.';
    const others = otherMaps.length > 0 ? ` Other maps with samples: ${otherMaps.join(', ')}.` : '';
    this.#samplesHead.textContent = (samples.length > 0 ? 'Click a sample to send it.' : none) + others;
    this.strip.show(samples);
    if (this.#sample !== null && samples.some((each) => each.name === this.#sample)) {
      this.strip.mark(this.#sample);
    } else if (this.#sample !== null) { // the sample is of another map
      this.#sample = null;
      this.#take(NO_QUERY);
    }
  }

  set busy(busy: boolean) {
    this.#send.classList.toggle('busy', busy);
    this.element.setAttribute('aria-busy', String(busy));
  }

  /** Files that were chosen, or dropped anywhere on the page. */
  async takeFiles(files: File[]): Promise<void> {
    try {
      const { query, unknown } = await sorted(files);
      this.strip.mark(null);
      this.#sample = null;
      this.#take({ ...this.#query, ...(query.rgb ? { truth: null } : {}), ...query });
      if (unknown.length > 0) throw new Error(`${unknown.join(', ')}: this file is not an image, a request or a ground truth. Drop RGB, depth and camera.json.`);
    } catch (error) {
      this.actions.failed(error);
    }
  }

  #take(query: Query): void {
    this.#query = query;
    this.#request.value = query.request;
    this.#refresh();
  }

  #refresh(): void {
    const { rgb, depth, request, truth } = this.#query;
    const row = (name: string, given: NamedBlob | null): HTMLElement =>
      element('li', { class: given ? 'given' : '' }, element('b', {}, name), given ? given.name : 'missing');
    this.#chosen.replaceChildren(
      row('RGB', rgb),
      row('Depth', depth),
      element('li', { class: request === '' ? '' : 'given' }, element('b', {}, 'Camera'), request === '' ? 'missing' : 'in the request below'),
      element('li', { class: truth ? 'given' : 'optional' }, element('b', {}, 'Ground truth'), truth ? 'given' : 'optional'),
    );
    this.#send.disabled = rgb === null || depth === null || request.trim() === '';
  }

  #dropZone(): HTMLElement {
    const input = element('input', {
      type: 'file', multiple: true, id: 'files', accept: '.png,.jpg,.jpeg,.webp,.tif,.tiff,.npy,.sfd1,.json,.txt', class: 'file',
    });
    input.addEventListener('change', () => {
      void this.takeFiles([...(input.files ?? [])]).then(() => {
        input.value = '';
      });
    });
    return element(
      'label',
      { class: 'drop', for: 'files' },
      element('b', {}, 'Drop or choose files'),
      element('span', {}, 'RGB, depth, camera.json, and optionally a ground truth'),
      input,
    );
  }

  #copy(made: () => string): void {
    try {
      navigator.clipboard.writeText(made()).then(
        () => {
          this.#copied.textContent = 'Copied.';
        },
        (error: unknown) => {
          this.actions.failed(new Error(`The browser did not allow copying: ${String(error)}`));
        },
      );
    } catch (error) {
      this.actions.failed(error);
    }
  }
}

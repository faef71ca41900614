// Everything that a question is put together from.
import type { Prior } from '../contract';
import { button, element } from '../element';
import type { Service } from '../service';
import { asCurl, asPython } from './copy_as';
import { sorted } from './files';
import { PriorFields } from './prior_fields';
import { NO_QUESTION, requestFrom, type NamedBlob, type Question } from './question';
import type { Offer } from './samples_of_map';
import { SampleStrip } from './sample_strip';

export interface Asked {
  ask: (question: Question) => void;
  drawsPrior: (draws: boolean) => void;
  priorChanged: (prior: Prior | null) => void;
  /** Name of the map that is shown. */
  map: () => string | null;
  prior: () => Prior | null;
  failed: (error: unknown) => void;
}

export class AskPanel {
  readonly element: HTMLElement;
  readonly strip: SampleStrip;
  readonly prior: PriorFields;
  readonly #samplesHead = element('p', { class: 'hint' });
  readonly #chosen = element('ul', { class: 'chosen' });
  readonly #request = element('textarea', { id: 'request', rows: '5', spellcheck: 'false', placeholder: '{"camera": {"width": 640, "height": 480, "fx": …}}' });
  readonly #ask: HTMLButtonElement;
  readonly #copied = element('span', { class: 'hint', role: 'status' });
  #question: Question = NO_QUESTION;
  /** Name of the sample that was chosen. */
  #sample: string | null = null;

  constructor(service: Service, readonly asked: Asked) {
    this.strip = new SampleStrip(service, (name, loading) => {
      loading.then((question) => {
        this.#sample = name;
        this.#take(question);
        asked.ask(question);
      }, asked.failed);
    });
    this.prior = new PriorFields(asked.drawsPrior, asked.priorChanged);
    this.#ask = button('Where was this?', () => {
      asked.ask(this.#question);
    }, { class: 'primary', disabled: true });
    this.#request.addEventListener('input', () => {
      this.#question = { ...this.#question, request: this.#request.value };
      this.#refresh();
    });
    const copy = (label: string, made: typeof asCurl): HTMLButtonElement =>
      button(label, () => {
        this.#copy(() => made(this.#question, requestFrom(this.#question, null, asked.prior()), service.base, service.key !== ''));
      }, { class: 'small' });
    this.element = element(
      'div',
      { class: 'panel' },
      element('section', {}, element('h2', {}, 'Sample pairs'), this.#samplesHead, this.strip.element),
      element('section', {}, element('h2', {}, 'Your own'), this.#dropZone(), this.#chosen),
      element('section', {}, element('h2', {}, element('label', { for: 'request' }, 'Request')), this.#request),
      element('details', {}, element('summary', {}, 'Prior: where the camera is believed to be'), this.prior.element),
      element('div', { class: 'row sticky' }, this.#ask, copy('Copy as curl', asCurl), copy('as Python', asPython)),
      this.#copied,
    );
    this.#refresh();
  }

  /** Show the sample pairs of the map that is shown, and name the other maps that have some. */
  offer({ samples, otherMaps }: Offer): void {
    const none = otherMaps.length > 0 ? 'None of this map.' : 'None here. "streetfix demo" makes some; STREETFIX_SAMPLES names a folder of them.';
    const others = otherMaps.length > 0 ? ` Others belong to: ${otherMaps.join(', ')}.` : '';
    this.#samplesHead.textContent = (samples.length > 0 ? 'Click one: it is asked at once.' : none) + others;
    this.strip.show(samples);
    if (this.#sample !== null && samples.some((each) => each.name === this.#sample)) {
      this.strip.mark(this.#sample);
    } else if (this.#sample !== null) { // it is of another map
      this.#sample = null;
      this.#take(NO_QUESTION);
    }
  }

  set busy(busy: boolean) {
    this.#ask.classList.toggle('busy', busy);
    this.element.setAttribute('aria-busy', String(busy));
  }

  /** Files that were chosen, or dropped anywhere on the page. */
  async takeFiles(files: File[]): Promise<void> {
    try {
      const { question, unknown } = await sorted(files);
      this.strip.mark(null);
      this.#sample = null;
      this.#take({ ...this.#question, ...(question.rgb ? { truth: null } : {}), ...question });
      if (unknown.length > 0) throw new Error(`${unknown.join(', ')}: no picture, request or truth file. Drop RGB, depth and camera.json.`);
    } catch (error) {
      this.asked.failed(error);
    }
  }

  #take(question: Question): void {
    this.#question = question;
    this.#request.value = question.request;
    this.#refresh();
  }

  #refresh(): void {
    const { rgb, depth, request, truth } = this.#question;
    const row = (name: string, given: NamedBlob | null): HTMLElement =>
      element('li', { class: given ? 'given' : '' }, element('b', {}, name), given ? given.name : 'missing');
    this.#chosen.replaceChildren(
      row('RGB', rgb),
      row('Depth', depth),
      element('li', { class: request === '' ? '' : 'given' }, element('b', {}, 'Camera'), request === '' ? 'missing' : 'in the request below'),
      element('li', { class: truth ? 'given' : 'optional' }, element('b', {}, 'Truth'), truth ? 'given' : 'optional'),
    );
    this.#ask.disabled = rgb === null || depth === null || request.trim() === '';
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
      element('span', {}, 'RGB, depth, camera.json, and a truth file if there is one'),
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
          this.asked.failed(new Error(`The browser did not let the page copy: ${String(error)}`));
        },
      );
    } catch (error) {
      this.asked.failed(error);
    }
  }
}

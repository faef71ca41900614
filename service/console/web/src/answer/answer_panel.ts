// The answer in words and numbers, and its intermediate images.
import type { Answer, Explanation, Pose, Truth } from '../contract';
import { element, facts } from '../element';
import { ellipseOf } from '../map/ellipse';
import { degrees, metres, milliseconds, percent } from '../numbers';
import { ServiceError } from '../service';
import { errorOf } from '../query/truth';
import { calibrationRows } from './calibration_rows';
import { IntermediateImages } from './intermediate_images';

const STATUS_TEXT = {
  LOCALIZED: 'Localized',
  AMBIGUOUS: 'Ambiguous',
  OUT_OF_MAP: 'Out of map',
} as const;
const STATUS_MEANING = {
  LOCALIZED: 'Use the pose with its covariance.',
  AMBIGUOUS: 'In the map, but the position is uncertain. There is no pose. See the hypotheses. A prior or more frames can decide.',
  OUT_OF_MAP: 'The images do not match the map. There is no pose. Do not use the hypotheses as one.',
} as const;
/** Confidence is the probability that the position is within this distance of the true one, metres. */
const WRONG_M = 1;
const STAGES = ['decode', 'fuse', 'encode', 'search', 'register'] as const;

export class AnswerPanel {
  readonly element = element('div', { class: 'panel', 'aria-live': 'polite' });
  readonly #images = new IntermediateImages();
  readonly #check = element('p', { class: 'check' });

  constructor() {
    this.element.append(
      element(
        'div',
        { class: 'empty' },
        element('h2', {}, 'Localize an image pair'),
        element('p', {}, 'Click a sample pair, or drop an RGB image and a depth image with their camera. The map shows the answer. This panel shows the intermediate images.'),
      ),
    );
  }

  show(explanation: Explanation, rgb: Blob, truth: Truth | null, elapsedMs: number): void {
    const { answer } = explanation;
    this.#images.show(rgb, explanation);
    this.showCheck('');
    this.element.replaceChildren(
      this.#head(answer, truth),
      this.#check,
      answer.pose === null ? this.#why(answer) : '',
      answer.pose === null ? this.#spread(answer) : this.#pose(answer, answer.pose),
      answer.hypotheses.length > (answer.pose === null ? 0 : 1) ? this.#hypotheses(answer) : '',
      element('section', {}, element('h2', {}, 'Intermediate images'), this.#images.element),
      this.#neighbours(answer),
      this.#times(answer, elapsedMs),
    );
  }

  /** Show the state or the result of the check of the focal length; `found`: it found an error. */
  showCheck(text: string, found = false): void {
    this.#check.textContent = text;
    this.#check.classList.toggle('found', found);
  }

  fail(error: unknown): void {
    const ours = error instanceof ServiceError ? error : null;
    const detail = error instanceof Error ? error.message : String(error);
    this.element.replaceChildren(
      element(
        'div',
        { class: 'problem', role: 'alert' },
        element('h2', {}, ours?.title ?? 'The query is invalid.'),
        element('p', {}, detail),
        ours === null || ours.status === 0
          ? null
          : element('p', { class: 'hint' }, [`HTTP ${ours.status}`, ours.code, ours.field && `field ${ours.field}`, ours.requestId && `request ${ours.requestId}`].filter(Boolean).join(' · ')),
      ),
    );
  }

  #head(answer: Answer, truth: Truth | null): HTMLElement {
    const error = truth === null ? null : errorOf(answer, truth);
    return element(
      'div',
      { class: `verdict ${answer.status.toLowerCase()}` },
      element('p', { class: 'status' }, STATUS_TEXT[answer.status]),
      element('p', { class: 'street' }, answer.pose === null ? 'no pose' : (answer.street?.name ?? 'no street')),
      element('p', { class: 'meaning' }, STATUS_MEANING[answer.status]),
      element(
        'div',
        { class: 'figures' },
        figure(answer.confidence === null ? 'not calibrated' : percent(answer.confidence), 'within 1 m'),
        error === null ? null : figure(metres(error.metres), error.degrees === null ? 'from the ground truth' : `and ${degrees(error.degrees)} from the ground truth`, error.metres > WRONG_M),
      ),
    );
  }

  #why(answer: Answer): HTMLElement {
    if (answer.reasons.length === 0) {
      return element(
        'section',
        { class: 'why' },
        element('h2', {}, 'Why there is no pose'),
        element('p', {}, 'All confidence features are in the range of the calibration data. The place may be outside the map or a perceptual alias.'),
      );
    }
    const list = element('ol');
    for (const { check, evidence, remedy } of answer.reasons) {
      const deviations = Object.entries(evidence).map(([name, value]) => `${name} ${value > 0 ? '+' : '−'}${Math.abs(value).toFixed(1)} σ`);
      list.append(element('li', {}, element('b', {}, check), element('span', {}, remedy), deviations.length === 0 ? null : element('span', { class: 'hint' }, deviations.join(', '))));
    }
    return element('section', { class: 'why' }, element('h2', {}, 'What to check, the likeliest cause first'), list);
  }

  #spread(answer: Answer): HTMLElement {
    const rows: [string, string][] = [];
    if (answer.spread !== null) {
      const ellipse = ellipseOf(answer.spread.covariance);
      rows.push(['σ on the ground', `${metres(ellipse.major)} × ${metres(ellipse.minor)}`]);
      rows.push(['σ heading', degrees(answer.spread.heading_std_deg)]);
      rows.push(['weight of hypotheses', percent(answer.spread.hypotheses_weight)]);
    }
    rows.push(...calibrationRows(answer), ...heightRow(answer));
    rows.push(['map', `${answer.map.name} ${answer.map.version.slice(0, 8)}`]);
    return element('section', {}, element('h2', {}, 'Possible positions'), facts(rows));
  }

  #pose(answer: Answer, pose: Pose): HTMLElement {
    const { position, heading_deg, covariance } = pose;
    const rows: [string, string][] = [
      ['x, y, z', `${position.x.toFixed(2)}, ${position.y.toFixed(2)}, ${position.z.toFixed(2)} m`],
      ['heading', degrees(heading_deg)],
    ];
    if (covariance !== null) {
      const ellipse = ellipseOf(covariance);
      rows.push(['σ on the ground', `${metres(ellipse.major)} × ${metres(ellipse.minor)}`]);
      rows.push(['σ heading', degrees((180 / Math.PI) * Math.sqrt(covariance[35] ?? 0))]);
    }
    rows.push(...calibrationRows(answer), ...heightRow(answer));
    rows.push(['map', `${answer.map.name} ${answer.map.version.slice(0, 8)}`]);
    return element('section', {}, element('h2', {}, 'Pose'), facts(rows));
  }

  #hypotheses(answer: Answer): HTMLElement {
    return element(
      'section',
      {},
      element('h2', {}, answer.pose === null ? 'Hypotheses, not confirmed' : 'Hypotheses'),
      table(
        ['', 'support', 'inliers', 'x, y', 'heading'],
        answer.hypotheses.map((each, k) => [
          `${k + 1}`,
          percent(each.share),
          percent(each.inliers),
          `${each.pose.position.x.toFixed(1)}, ${each.pose.position.y.toFixed(1)}`,
          degrees(each.pose.heading_deg),
        ]),
      ),
    );
  }

  #neighbours(answer: Answer): HTMLElement {
    const { pose } = answer;
    return element(
      'section',
      {},
      element('h2', {}, 'Most similar places'),
      table(
        ['', 'place', 'similarity', 'street', ...(pose === null ? [] : ['distance'])],
        answer.neighbours.map((each, k) => [
          `n${k + 1}`,
          `${each.place}`,
          each.similarity.toFixed(3),
          each.street ?? '–',
          ...(pose === null ? [] : [metres(Math.hypot(each.position.x - pose.position.x, each.position.y - pose.position.y), 1)]),
        ]),
      ),
    );
  }

  #times(answer: Answer, elapsedMs: number): HTMLElement {
    const times = answer.timings_ms;
    const longest = Math.max(1, ...STAGES.map((stage) => times[stage]));
    const bars = element('ul', { class: 'times' });
    for (const stage of STAGES) {
      const bar = element('span', { class: 'bar', 'aria-hidden': 'true' });
      bar.style.width = `${(100 * times[stage]) / longest}%`;
      bars.append(element('li', {}, element('span', {}, stage), element('span', { class: 'track' }, bar), element('b', {}, milliseconds(times[stage]))));
    }
    return element(
      'section',
      {},
      element('h2', {}, 'Time'),
      bars,
      element('p', { class: 'hint' }, `${milliseconds(times.total)} in the service, ${milliseconds(elapsedMs)} from sending to the answer`),
    );
  }
}

function heightRow({ camera_height }: Answer): [string, string][] {
  return camera_height === null ? [] : [['camera above ground', `${metres(camera_height.height_m)}, ${camera_height.origin}`]];
}

function figure(value: string, name: string, wrong = false): HTMLElement {
  return element('div', wrong ? { class: 'wrong' } : {}, element('b', {}, value), element('span', {}, name));
}

function table(heads: string[], rows: string[][]): HTMLElement {
  return element(
    'div',
    { class: 'scroll', tabindex: '0', role: 'group', 'aria-label': heads.filter(Boolean).join(', ') },
    element(
      'table',
      {},
      element('thead', {}, element('tr', {}, ...heads.map((each) => element(each === '' ? 'td' : 'th', each === '' ? {} : { scope: 'col' }, each)))),
      element('tbody', {}, ...rows.map((row) => element('tr', {}, ...row.map((cell) => element('td', {}, cell))))),
    ),
  );
}

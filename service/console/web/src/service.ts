// The service's REST interface. The key stays in this tab: in memory and in `sessionStorage`, so that a reload keeps it.
import type { Answer, Explanation, LastAnswer, MapEntry, SamplePair, StreetFeature } from './contract';

const KEY = 'streetfix-key';

/** A problem of the service (problem+json), or an unreachable service: `status` 0. */
export class ServiceError extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    readonly title: string,
    detail: string,
    readonly field: string | null = null,
    readonly requestId: string | null = null,
  ) {
    super(detail);
  }
}

interface Problem {
  title?: string;
  detail?: string;
  code?: string;
  field?: string | null;
  request_id?: string;
}

export class Service {
  /** Base address of the service, also behind a proxy with a path prefix. */
  readonly base = new URL('../', document.baseURI);
  #key = sessionStorage.getItem(KEY) ?? '';

  get key(): string {
    return this.#key;
  }

  set key(value: string) {
    this.#key = value;
    if (value === '') sessionStorage.removeItem(KEY);
    else sessionStorage.setItem(KEY, value);
  }

  async maps(): Promise<MapEntry[]> {
    return (await this.#json<{ maps: MapEntry[] }>('v1/maps')).maps;
  }

  async streets(map: string): Promise<StreetFeature[]> {
    return (await this.#json<{ features: StreetFeature[] }>(`v1/maps/${encodeURIComponent(map)}/streets`)).features;
  }

  async coverageReach(): Promise<number> {
    const coverage = await this.#json<{ features: { properties: { reach_m: number } }[] }>('v1/coverage');
    return coverage.features[0]?.properties.reach_m ?? 0;
  }

  cloud(map: string, points: number): Promise<ArrayBuffer> {
    return this.#bytes(`v1/maps/${encodeURIComponent(map)}/cloud?points=${points}`);
  }

  places(map: string): Promise<ArrayBuffer> {
    return this.#bytes(`v1/maps/${encodeURIComponent(map)}/places`);
  }

  async samples(): Promise<SamplePair[]> {
    return (await this.#json<{ samples: SamplePair[] }>('v1/samples')).samples;
  }

  async sampleImage(address: string): Promise<Blob> {
    return (await this.#send(`v1/${address}`)).blob();
  }

  explain(body: FormData): Promise<Explanation> {
    return this.#json<Explanation>('v1/explain', { method: 'POST', body });
  }

  localize(body: FormData): Promise<Answer> {
    return this.#json<Answer>('v1/localize', { method: 'POST', body });
  }

  serve(map: string, version: string): Promise<MapEntry> {
    return this.#json<MapEntry>(`v1/maps/${encodeURIComponent(map)}/serving`, {
      method: 'PUT',
      headers: { 'Content-Type': 'application/json' },
      body: JSON.stringify({ version }),
    });
  }

  async lastAnswers(): Promise<LastAnswer[]> {
    return (await this.#json<{ answers: LastAnswer[] }>('v1/answers?most=50')).answers;
  }

  async metrics(): Promise<string> {
    return (await this.#send('metrics')).text();
  }

  async #json<T>(path: string, init: RequestInit = {}): Promise<T> {
    return (await (await this.#send(path, init)).json()) as T;
  }

  async #bytes(path: string): Promise<ArrayBuffer> {
    return (await this.#send(path)).arrayBuffer();
  }

  async #send(path: string, init: RequestInit = {}): Promise<Response> {
    const headers = new Headers(init.headers);
    if (this.#key !== '') headers.set('X-Api-Key', this.#key);
    let response: Response;
    try {
      response = await fetch(new URL(path, this.base), { ...init, headers, cache: 'no-store' });
    } catch (error) {
      const detail = `${this.base.host} does not answer. Check that the service is running (${String(error)}).`;
      throw new ServiceError(0, 'unreachable', 'The service cannot be reached.', detail);
    }
    if (!response.ok) throw await problemOf(response);
    return response;
  }
}

async function problemOf(response: Response): Promise<ServiceError> {
  const text = await response.text();
  let problem: Problem;
  try {
    problem = JSON.parse(text) as Problem;
  } catch {
    problem = { detail: text.slice(0, 300) }; // an error page of a proxy
  }
  return new ServiceError(
    response.status,
    problem.code ?? 'http',
    problem.title ?? `HTTP ${response.status}`,
    problem.detail ?? response.statusText,
    problem.field ?? null,
    problem.request_id ?? null,
  );
}

// Sorts dropped files by kind: by content if it decides, otherwise by name.
import type { Query } from './query';
import { truthFrom } from './truth';

const DEPTH_ALONE = /\.(npy|tiff?|sfd1|rvl|raw16|exr|zst)$/i;
const DEPTH_NAME = /depth|disp|(^|[/_-])d[_-]?\d/i;
const IMAGE = /\.(png|jpe?g|webp)$/i;
const IHDR_DEPTH = 24;

export interface Sorted {
  query: Partial<Query>;
  /** Names of files of no known kind. */
  unknown: string[];
}

export async function sorted(files: File[]): Promise<Sorted> {
  const query: Partial<Query> = {};
  const unknown: string[] = [];
  for (const file of files) {
    const kind = await kindOf(file);
    if (kind === 'unknown') unknown.push(file.name);
    else if (kind === 'rgb' || kind === 'depth') query[kind] = { name: file.name, blob: file };
    else if (kind === 'request') query.request = await file.text();
    else query.truth = truthFrom(await file.text(), query.rgb?.name ?? files[0]?.name ?? '');
  }
  return { query, unknown };
}

async function kindOf(file: File): Promise<'rgb' | 'depth' | 'request' | 'truth' | 'unknown'> {
  if (/\.json$/i.test(file.name)) return (await file.text()).includes('"camera"') ? 'request' : 'truth';
  if (/\.(txt|tum)$/i.test(file.name)) return 'truth';
  if (DEPTH_ALONE.test(file.name)) return 'depth';
  if (/\.png$/i.test(file.name)) return (await isDeepGrey(file)) || DEPTH_NAME.test(file.name) ? 'depth' : 'rgb';
  return IMAGE.test(file.name) ? 'rgb' : 'unknown';
}

/** A PNG of one channel with 16 bits is depth, whatever its name. */
async function isDeepGrey(file: File): Promise<boolean> {
  const head = new Uint8Array(await file.slice(0, IHDR_DEPTH + 2).arrayBuffer());
  return head[IHDR_DEPTH] === 16 && head[IHDR_DEPTH + 1] === 0;
}

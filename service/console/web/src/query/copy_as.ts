// The same request as commands, without the key.
import type { LocalizeRequest } from '../contract';
import type { Query } from './query';

export function asCurl(query: Query, request: LocalizeRequest, base: URL, hasKey: boolean): string {
  const quoted = (text: string): string => `'${text.replaceAll("'", `'\\''`)}'`;
  const parts = [
    `-F ${quoted(`rgb=@${query.rgb?.name ?? 'rgb.jpg'}`)}`,
    `-F ${quoted(`depth=@${query.depth?.name ?? 'depth.png'}`)}`,
    `-F ${quoted(`request=${JSON.stringify(request)}`)}`,
  ];
  if (hasKey) parts.unshift('-H "X-Api-Key: $STREETFIX_KEY"');
  return `curl ${parts.join(' \\\n  ')} \\\n  ${quoted(new URL('v1/localize', base).href)}`;
}

export function asPython(query: Query, request: LocalizeRequest, base: URL, hasKey: boolean): string {
  const lines = [
    'import json',
    ...(hasKey ? ['import os'] : []),
    '',
    'import httpx',
    '',
    `request = json.loads(${JSON.stringify(JSON.stringify(request))})`,
    `with open(${JSON.stringify(query.rgb?.name ?? 'rgb.jpg')}, "rb") as rgb, open(${JSON.stringify(query.depth?.name ?? 'depth.png')}, "rb") as depth:`,
    '    response = httpx.post(',
    `        ${JSON.stringify(new URL('v1/localize', base).href)},`,
    '        files={"rgb": rgb, "depth": depth, "request": (None, json.dumps(request))},',
    ...(hasKey ? ['        headers={"X-Api-Key": os.environ["STREETFIX_KEY"]},'] : []),
    '    )',
    'response.raise_for_status()',
    'answer = response.json()',
    'print(answer["status"], answer["confidence"])',
    'if answer["status"] == "LOCALIZED":  # otherwise there is no pose',
    '    print(answer["pose"]["position"])',
  ];
  return lines.join('\n') + '\n';
}

// Which sample pairs belong to a map, by the map that their request names.
import type { SamplePair } from '../contract';

export interface Offer {
  /** Samples of the map. A sample whose request names no map belongs to every map. */
  samples: SamplePair[];
  /** Names of the other maps that have samples. */
  otherMaps: string[];
}

export function samplesOfMap(all: SamplePair[], map: string): Offer {
  const nameOf = (sample: SamplePair): string => sample.request.map?.split('@')[0] ?? map;
  const others = all.map(nameOf).filter((each) => each !== map);
  return { samples: all.filter((sample) => nameOf(sample) === map), otherMaps: [...new Set(others)] };
}

// What server and page say to each other, for `tsc`, which checks the page by its JSDoc comments (`make page-types`).
// The server's side: `ortho_measure/project.py`, `session.py`, `block/` and `serving/server.py`.

declare const ol: any; // OpenLayers, vendored as one file; its classes are not checked

type Pair = [number, number] | number[];
type Places = { [view: string]: Pair | null };
type Pane = 'scene' | 'reference';

interface Ray {
  image: Pair;
  sigma_image?: number | null;
  covariance?: number[] | null;
  group?: number | null;
  how: 'manual' | 'matched' | 'file';
  score?: number | null;
}

/** A point as the server keeps it. */
interface Mark {
  id: string;
  image?: Pair | null;
  ground: number[] | null;
  role: string;
  off: boolean;
  sigma_image?: number | null;
  covariance?: number[] | null;
  sigma_xy: number;
  sigma_h: number;
  sigma_common?: number;
  sigma_alike?: number;
  group?: number | null;
  how: 'manual' | 'matched' | 'file';
  ground_from: 'reference' | 'typed' | 'file' | null;
  score?: number | null;
  rays: { [label: string]: Ray };
  note: string;
  places?: Places;
}

/** What the solution says of a point; of one image and of several. */
interface Figures {
  residual?: Pair | null;
  residual_m?: number[] | null;
  loo?: any;
  predicted?: Pair | null;
  used?: boolean;
  w?: number | null;
  suspicious?: boolean;
  reason?: string;
  residuals?: { [label: string]: Pair | null };
  loo_m?: (number | null)[];
  sigma_m?: number[] | null;
}

type Shown = Mark & Figures;

interface Next {
  image: Pair;
  sigma: number | null;
  largest: number | null;
  then: number | null;
  number: number;
  height: number | null;
  role: string;
  places: Places;
}

/** All that changes with the points. */
interface State {
  marks: Mark[];
  version: number;
  undo: boolean;
  redo: boolean;
  actions: number;
  next: Next[];
  error: string;
  points: { [id: string]: Figures };
  headline: { px: number | null; m: number | null; what: string; n?: number };
  notices: string[];
  correction: string | null;
}

interface Raster { name: string; size: Pair }

/** What does not change. */
interface Facts {
  images: Raster[];
  maps: Raster[];
  labels: string[] | null;
  output: string;
  tile: number;
  bands: { [view: string]: number };
  corrections: string[];
  writes: boolean;
  locked: boolean;
  healed: boolean;
  stopped: string;
  state: State;
}

/** A match of a click in the scene, or of a ground. */
interface Match {
  image: Pair;
  ground: number[];
  score: number;
  covariance: number[];
  scattered: number;
  reason: string;
}

/** A match in one of several images. */
interface RayMatch {
  seen: boolean;
  reason: string;
  image: Pair | null;
  covariance?: number[] | null;
  score?: number | null;
}

interface Making { state: 'none' | 'running' | 'done' | 'failed'; stage?: string; share: number; number: number; figure: string; what: string; files: string[]; error: string }

interface Compared { rows: any[]; recommendation: { model: string | null; reason: string } }

/** What the server answers to each request. */
interface Answers {
  begin: Facts;
  act: State;
  state: State;
  propose: Match;
  tie: { rays: { [label: string]: RayMatch }; ground: Match | null };
  predict: { ground: number[] | null; places: Places; sigma: number[] | null };
  link: Link;
  typed: { ground: number[] };
  stretch: { limits: Pair[] };
  compare: Compared;
  make: Making;
  made: Making;
  save: {};
  leave: {};
}

interface Link { place: Pair | null; matrix: number[][] | null }

/** The point under way. */
type Pending = Mark & { first?: string | null; was?: string; by_hand?: boolean; clicked?: boolean };

interface Look { bands: number[]; limits: Pair[] | null }

/** Where a mark is in a view. */
interface Placed { place: Pair | null; residual?: Pair | null; expected?: boolean }

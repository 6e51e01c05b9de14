// The views: scene and reference share one OpenLayers view in pixels of the scene, so that they pan and zoom as one.
// OpenLayers' y goes up: a pixel (column, row) lies at (column, -row).
/* global ol */

const SHAPES = { control: 3, check: 0, tie: 4 };
const COLOURS = { control: '#ffb000', check: '#35c3ff', tie: '#8be04e' };
const at = ([column, row]) => [column, -row];
export const pixel = ([x, y]) => [x, -y];

/** Tiles of one pane in one rendering; `show` gives them another rendering, bands or contrast. */
function tiled(pane, size, tile, projection) {
  const resolutions = [1];
  while (Math.max(...size) / resolutions[0] > tile) resolutions.unshift(resolutions[0] * 2);
  const grid = new ol.tilegrid.TileGrid({ origin: [0, 0], extent: [0, -size[1], size[0], 0], resolutions, tileSize: tile });
  const source = new ol.source.TileImage({ projection, tileGrid: grid, transition: 0, interpolate: false, url: '' });
  return {
    source,
    show({ version, bands, limits }) {
      const query = `b=${bands.join(',')}&l=${limits.flat().join(',')}`;
      source.setTileUrlFunction(([z, x, y]) => (x < 0 || y < 0 ? undefined
        : `tiles/${pane}/${version}/${resolutions[z]}/${x}/${y}?${query}`), `${version}?${query}`);
    },
  };
}

function symbol(mark, selected) {
  const off = mark.off || !mark.image || !mark.ground;
  const stroke = new ol.style.Stroke({ color: mark.suspicious ? '#ff3b1f' : COLOURS[mark.role], width: selected ? 4 : 2 });
  const fill = new ol.style.Fill({ color: off ? 'rgba(0,0,0,0)' : 'rgba(0,0,0,.35)' });
  const points = SHAPES[mark.role];
  return new ol.style.Style({
    image: points ? new ol.style.RegularShape({ points, radius: 9, stroke, fill, angle: points === 4 ? Math.PI / 4 : 0 })
      : new ol.style.Circle({ radius: 7, stroke, fill }),
    text: new ol.style.Text({ text: mark.id, offsetY: -16, font: '600 12px system-ui, sans-serif', fill: new ol.style.Fill({ color: '#fff' }),
      stroke: new ol.style.Stroke({ color: '#000', width: 3 }) }),
  });
}

const line = (color, width, lineDash) => new ol.style.Style({ stroke: new ol.style.Stroke({ color, width, lineDash }) });
const CROSS = [new ol.style.Style({ image: new ol.style.RegularShape({ points: 4, radius: 11, radius2: 0, stroke: new ol.style.Stroke({ color: '#000', width: 4 }) }) }),
  new ol.style.Style({ image: new ol.style.RegularShape({ points: 4, radius: 11, radius2: 0, stroke: new ol.style.Stroke({ color: '#ff4fd8', width: 2 }) }) })];
const NEXT = new ol.style.Style({ image: new ol.style.Circle({ radius: 16, stroke: new ol.style.Stroke({ color: '#fff', width: 2, lineDash: [5, 5] }) }) });

export class Views {
  /** @param {{size: number[], tile: number}} facts @param {(pane: string, place: number[], hit: string|null) => void} clicked @param {(pane: string, id: string, place: number[]) => void} dragged */
  constructor(facts, clicked, dragged) {
    const [width, height] = facts.size;
    const projection = new ol.proj.Projection({ code: 'image', units: 'pixels', extent: [0, -height, width, 0] });
    this.tiles = { scene: tiled('scene', facts.size, facts.tile, projection), reference: tiled('reference', facts.size, facts.tile, projection) };
    this.view = new ol.View({ projection, center: [width / 2, -height / 2], minResolution: 1 / 32,
      maxResolution: Math.max(width, height) / 250, resolution: 1, enableRotation: false, smoothExtentConstraint: false });
    this.marks = { scene: new ol.source.Vector(), reference: new ol.source.Vector() };
    this.maps = {};
    const extent = projection.getExtent(); // tiles reach beyond the scene, where the reference goes on
    this.over = new ol.layer.Tile({ source: this.tiles.reference.source, visible: false, extent });
    this.swipe = 0;
    this.difference = false;
    this.over.on('prerender', (event) => this.#clip(event));
    this.over.on('postrender', (event) => { event.context.restore(); });
    for (const pane of ['scene', 'reference']) {
      const layers = [new ol.layer.Tile({ source: this.tiles[pane].source, extent })];
      if (pane === 'scene') layers.push(this.over);
      layers.push(new ol.layer.Vector({ source: this.marks[pane], updateWhileAnimating: true, updateWhileInteracting: true }));
      const map = new ol.Map({ target: pane, view: this.view, controls: [], layers });
      map.on('click', (event) => {
        const hit = map.forEachFeatureAtPixel(event.pixel, (feature) => feature.getId() ?? null, { hitTolerance: 4 });
        document.getElementById(pane).focus();
        clicked(pane, pixel(event.coordinate), hit ?? null);
      });
      const drag = new ol.interaction.Translate({ filter: (feature) => feature.getId() !== undefined, hitTolerance: 4 });
      drag.on('translateend', (event) => event.features.forEach((feature) => dragged(pane, feature.getId(), pixel(feature.getGeometry().getCoordinates()))));
      map.addInteraction(drag);
      this.maps[pane] = map;
    }
    this.loupes = {};
    for (const pane of ['scene', 'reference']) {
      const view = new ol.View({ projection, center: at([width / 2, height / 2]), resolution: 1 / 6, enableRotation: false });
      this.loupes[pane] = new ol.Map({ target: `loupe-${pane}`, view, controls: [], interactions: [],
        layers: [new ol.layer.Tile({ source: this.tiles[pane].source, extent })] });
    }
  }

  #clip(event) {
    const context = event.context;
    context.save();
    if (this.swipe > 0) {
      const width = context.canvas.width * (1 - this.swipe / 100);
      context.beginPath();
      context.rect(width, 0, context.canvas.width - width, context.canvas.height);
      context.clip();
    }
    if (this.difference) context.globalCompositeOperation = 'difference';
  }

  /** Show the reference in the scene's own pane: as a whole, right of a handle, or as a difference. */
  compare({ flicker, swipe, difference }) {
    this.swipe = flicker || difference ? 0 : swipe;
    this.difference = difference;
    this.over.setVisible(flicker || difference || swipe > 0);
    this.maps.scene.render();
  }

  /** Draw marks with their residuals, the point under way, and the next place. */
  draw(marks, selected, pending, next) {
    for (const pane of ['scene', 'reference']) {
      const source = this.marks[pane];
      source.clear(true);
      const features = [];
      const extent = Math.max(...marks.filter((mark) => mark.residual).map((mark) => Math.hypot(...mark.residual)), 0);
      for (const mark of marks) {
        const place = pane === 'scene' ? mark.image : mark.shown;
        if (!place) continue;
        if (pane === 'scene' && mark.residual && extent > 0) {
          // The longest vector is as long as 60 px of the screen.
          const scale = 60 / extent * this.view.getResolution();
          const end = [place[0] + mark.residual[0] * scale, place[1] + mark.residual[1] * scale];
          const vector = new ol.Feature(new ol.geom.LineString([at(place), at(end)]));
          vector.setStyle([line('#000', 4), line(mark.suspicious ? '#ff3b1f' : '#ffe600', 2)]);
          features.push(vector);
        }
        const feature = new ol.Feature(new ol.geom.Point(at(place)));
        feature.setId(mark.id);
        feature.setStyle(symbol(mark, mark.id === selected));
        features.push(feature);
      }
      const place = pending && (pane === 'scene' ? pending.image : pending.shown);
      if (place) { const feature = new ol.Feature(new ol.geom.Point(at(place))); feature.setStyle(CROSS); features.push(feature); }
      if (next) { const feature = new ol.Feature(new ol.geom.Point(at(next.image))); feature.setStyle(NEXT); features.push(feature); }
      source.addFeatures(features);
      if (place) this.loupes[pane].getView().setCenter(at(place));
    }
  }

  middle() { return pixel(this.view.getCenter()); }

  goTo(place, resolution) {
    this.view.setCenter(at(place));
    if (resolution && this.view.getResolution() > resolution) this.view.setResolution(resolution);
  }

  /** Show the whole scene. */
  whole(size) { this.view.fit([0, -size[1], size[0], 0], { size: this.maps.scene.getSize() }); }

  /** What is seen of the scene: left, top, right, bottom. */
  box() {
    const [left, low, right, high] = this.view.calculateExtent(this.maps.scene.getSize());
    return [left, -high, right, -low];
  }
}

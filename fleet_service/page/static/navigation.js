// Navigation to a part of the map: a place, an area, an alert, all cells.
import { byId } from "./elements.js";
import { worldX, worldY } from "./grid.js";

const PLACE_ZOOM = 18;
const ALERT_ZOOM = 17.5;
const ROUNDS = 8;
const DOT_PX = 0.1;
const DOT_ZOOM = 16;
const FAR = 1e-3; // share of the world's width: about 40 km

/** Show a point [deg], at a zoom at which streets are legible. */
export function goTo({ map: { view } }, longitude, latitude) {
  view.go(worldX(longitude), worldY(latitude), Math.max(view.zoom, ALERT_ZOOM));
}

/** Show the place of an alert, and move the keyboard focus to the map. */
export function jumpTo(page, alert) {
  goTo(page, alert.longitude, alert.latitude);
  byId("map").focus();
}

/** Show and choose the place at a point of the world, each coordinate from 0 to 1. */
export function showPlace({ map }, x, y) {
  map.view.go(x, y, Math.max(map.view.zoom, PLACE_ZOOM));
  map.chooseAt(x, y);
}

/** Show an area: its box is west, south, east, north [deg]. */
export function showArea({ map }, { box: [west, south, east, north] }) {
  map.view.fit({
    west: worldX(west),
    east: worldX(east),
    north: worldY(north),
    south: worldY(south),
  });
}

/** Show all points of a line: pairs of longitude and latitude [deg]. */
export function fitTo({ map }, points) {
  const xs = points.map(point => worldX(point[0]));
  const ys = points.map(point => worldY(point[1]));
  map.view.fit({
    west: Math.min(...xs),
    east: Math.max(...xs),
    north: Math.min(...ys),
    south: Math.max(...ys),
  });
}

/** Show all cells, including new ones, until the user moves the map. */
export async function showAll({ map, state }) {
  // Several rounds, because the first ones may know only tiles or squares instead of cells.
  for (let before = null, k = 0; k < ROUNDS; k++) {
    const { extent } = state.cells;
    const now = JSON.stringify(extent);
    if (now === before) return;
    before = now;
    if (extent) {
      map.view.fit(extent);
      map.view.gone = false;
    }
    await map.look();
    if (map.view.gone) return;
  }
}

/** Show the area with most alerts if there are several distant areas, else the whole map. */
export async function showFirst(page) {
  const { map, state } = page;
  const { extent } = state.now;
  if (extent && extent.east - extent.west > FAR) await page.updates.loadAreas();
  if (state.areas.length < 2) {
    await showAll(page);
    return;
  }
  showArea(page, state.areas[0]);
  await map.look();
}

/** Extend the view to new cells, unless the user has moved the map. */
export function followCells(page) {
  const {
    map: { view },
    state,
  } = page;
  const { box } = view;
  const extent = view.gone || state.past ? null : state.now.extent;
  if (!extent) return;
  const size =
    Math.max(
      (extent.east - extent.west) / view.width,
      (extent.south - extent.north) / view.height,
    ) * view.scale;
  const isDot = view.zoom < DOT_ZOOM && size < DOT_PX; // the cells are a dot on a map of the world
  if (
    isDot ||
    extent.west < box.west ||
    extent.east > box.east ||
    extent.north < box.north ||
    extent.south > box.south
  )
    showFirst(page);
}

// A vehicle in TypeScript: it publishes an observation, waits for its acknowledgement, subscribes to alerts and queries a
// tile.
//
// It uses only the definitions in schemas/README.md and schemas/proto/gripmap.proto. zenoh-ts needs Node.js 20 or later,
// and Zenoh's router `zenohd` with the remote-api plug-in.
//
//   npm ci && npm run build
//   npm start -- ws/127.0.0.1:10000 ../../../../schemas/proto/gripmap.proto berta 57.7 11.97 60
//
// Arguments: locator, message definitions, enrolled name of the vehicle, latitude and longitude of the ice, seconds to
// wait. It prints one line of JSON, and exits with 0 if the observation was acknowledged, an alert in its tile
// arrived and the tile arrived.
import { randomBytes } from "node:crypto";
import { Config, CongestionControl, Encoding, Priority, Sample, Session } from "@eclipse-zenoh/zenoh-ts";
import protobuf from "protobufjs";

const VISITS = 6;
const ZOOM = 14;
const FIRST_RETRY_S = 2;
const LAST_RETRY_S = 6;
// Longest wait for the router. The default of half a second is too short for a slow network.
const RESPONSE_S = 10;

interface SeqRange {
    first: string;
    last: string;
}

interface StreamAck {
    boot: string;
    kind: string;
    durable: SeqRange[];
    rejected: { seq: string; row: number; reason: string }[];
}

/** Return the quadkey of a place at zoom 14 as chunks <d4>/<d3>/<d3>/<d4>: its tile. The first three are its region. */
function tileKey(latitude: number, longitude: number): string {
    const side = 2 ** ZOOM;
    const phi = (latitude * Math.PI) / 180;
    const x = Math.floor(((longitude + 180) / 360) * side);
    const y = Math.floor(((1 - Math.asinh(Math.tan(phi)) / Math.PI) / 2) * side);
    let digits = "";
    for (let bit = ZOOM - 1; bit >= 0; bit--) digits += ((x >> bit) & 1) + 2 * ((y >> bit) & 1);
    return [digits.slice(0, 4), digits.slice(4, 7), digits.slice(7, 10), digits.slice(10)].join("/");
}

/** Return visits that used nearly all the grip of ice: one per second until now, heading north. */
function makeBatch(vehicle: string, boot: string, latitude: number, longitude: number): string {
    const now = BigInt(Date.now()) * 1_000_000n;
    const constants = { latitude, longitude, yaw: Math.PI / 2, mu: 0.2, mu_lower: 0.12, mu_upper: 0.28, mu_utilised: 0.19 };
    const columns = Object.entries(constants).map(([name, value]) => [name, Array(VISITS).fill(value)]);
    const times = Array.from({ length: VISITS }, (_, k) => String(now - BigInt(VISITS - 1 - k) * 1_000_000_000n));
    return JSON.stringify({ vehicle, boot, seq: "1", enter_time: times, ...Object.fromEntries(columns) });
}

/** Return "durable", or the reason of the rejection, if an acknowledgement settles batch 1 of this boot; else "". */
function readAck(type: protobuf.Type, payload: Uint8Array, boot: string): string {
    const ack = type.toObject(type.decode(payload), { longs: String, enums: String, arrays: true, defaults: true });
    for (const stream of ack.streams as StreamAck[]) {
        if (stream.boot !== boot || stream.kind !== "KIND_OBSERVATION") continue;
        if (stream.durable.some((range) => Number(range.first) <= 1 && 1 <= Number(range.last))) return "durable";
        if (stream.rejected.length > 0) return stream.rejected[0].reason;
    }
    return "";
}

/** Return `read()` as soon as it is not undefined, at the latest after some seconds. */
async function waitFor<T>(read: () => T | undefined, seconds: number): Promise<T | undefined> {
    const end = Date.now() + 1000 * seconds;
    while (read() === undefined && Date.now() < end) await new Promise((resolve) => setTimeout(resolve, 50));
    return read();
}

async function queryTile(session: Session, key: string): Promise<unknown[]> {
    const replies = await session.get(`gripmap/v1/map/${key}?format=geojson`);
    const features: unknown[] = [];
    if (replies === undefined) return features;
    for await (const reply of replies) {
        const result = reply.result();
        const text = new TextDecoder().decode(result.payload().toBytes());
        if (result instanceof Sample) features.push(...JSON.parse(text).features);
        else console.error(text);
    }
    return features;
}

async function main(words: string[]): Promise<number> {
    if (words.length !== 6) {
        console.error("usage: npm start -- LOCATOR PROTO VEHICLE LATITUDE LONGITUDE SECONDS");
        return 2;
    }
    const [locator, proto, vehicle] = words;
    const [latitude, longitude, patience] = words.slice(3).map(Number);
    const messages = await protobuf.load(proto);
    const ackType = messages.lookupType("gripmap.v1.Ack");
    const alertType = messages.lookupType("gripmap.v1.Alert");
    const boot = String(randomBytes(8).readBigUInt64LE() >> 1n);
    const tile = tileKey(latitude, longitude);
    let settled: string | undefined;
    let alertMu: number | undefined;

    const session = await Session.open(new Config(locator, 1000 * RESPONSE_S));
    await session.declareSubscriber(`gripmap/v1/ack/${vehicle}`, {
        handler: (sample: Sample) => (settled ||= readAck(ackType, sample.payload().toBytes(), boot) || undefined),
    });
    await session.declareSubscriber(`gripmap/v1/alert/${tile}`, {
        handler: (sample: Sample) => {
            const alert = alertType.toObject(alertType.decode(sample.payload().toBytes()), { defaults: true });
            if (alert.raised) alertMu = alert.mu;
        },
    });

    const batch = makeBatch(vehicle, boot, latitude, longitude);
    const end = Date.now() + 1000 * patience;
    for (let retry = FIRST_RETRY_S; settled === undefined && Date.now() < end; retry = Math.min(2 * retry, LAST_RETRY_S)) {
        await session.put(`gripmap/v1/obs/${tile.slice(0, 12)}/${vehicle}`, batch, {
            encoding: Encoding.APPLICATION_JSON,
            priority: Priority.DATA,
            congestionControl: CongestionControl.BLOCK,
        });
        await waitFor(() => settled, retry);
    }
    if (settled !== undefined && settled !== "durable") console.error(`rejected: ${settled}`);
    const isDurable = settled === "durable";
    const mu = isDurable ? await waitFor(() => alertMu, patience) : undefined;
    const cells = mu === undefined ? [] : await queryTile(session, tile);
    await session.close();
    console.log(JSON.stringify({ durable: isDurable, alert_mu: mu ?? -1, cells: cells.length }));
    return cells.length > 0 ? 0 : 1;
}

process.exit(await main(process.argv.slice(2)));

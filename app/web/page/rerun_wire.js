// The few messages of Rerun's viewer control that the page needs (viewer_control.proto of rerun 0.41), in protobuf's
// wire format: fields of a varint (0), 64 bits (1), bytes (2) or 32 bits (5).

const text = new TextEncoder();
const words = new TextDecoder();

function varint(value) {
  const bytes = [];
  let rest = BigInt.asUintN(64, BigInt(value));
  do {
    const low = Number(rest & 127n);
    rest >>= 7n;
    bytes.push(rest ? low | 128 : low);
  } while (rest);
  return bytes;
}

function field(number, value) {
  if (typeof value === "bigint" || typeof value === "boolean") return [...varint(number << 3), ...varint(value)];
  const bytes = typeof value === "string" ? text.encode(value) : value;
  return [...varint((number << 3) | 2), ...varint(bytes.length), ...bytes];
}

// {field number: [values]}; a value is a bigint or bytes.
function fields(bytes) {
  const found = {};
  let at = 0;
  const number = () => {
    let value = 0n;
    for (let shift = 0n; ; shift += 7n) {
      const byte = bytes[at++];
      value |= BigInt(byte & 127) << shift;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const key = Number(number());
    let value = null;
    if ((key & 7) === 0) value = BigInt.asIntN(64, number());
    else if ((key & 7) === 1) at += 8;
    else if ((key & 7) === 5) at += 4;
    else {
      const length = Number(number());
      value = bytes.subarray(at, at + length);
      at += length;
    }
    (found[key >> 3] ??= []).push(value);
  }
  return found;
}

const string = (bytes) => (bytes ? words.decode(bytes) : null);

export const PAUSED = 1n; // play states; FOLLOWING keeps to the newest row
export const FOLLOWING = 3n;

// {active, recordings: [{id, timeline, time, play, ends: {timeline: last time}}]}; times are bigints or null.
export function readState(bytes) {
  const state = fields(bytes);
  const recordings = (state[3] ?? []).map((entry) => {
    const recording = fields(entry);
    const cursor = recording[3] ? fields(recording[3][0]) : {};
    const timeline = cursor[1] ? string(fields(cursor[1][0])[1]?.[0]) : null;
    const ends = {};
    for (const item of recording[2] ?? []) {
      const known = fields(item);
      const name = string(fields(known[1][0])[1]?.[0]);
      if (known[3]) ends[name] = fields(known[3][0])[2]?.[0] ?? 0n;
    }
    const time = cursor[3] ? (fields(cursor[3][0])[1]?.[0] ?? 0n) : null;
    return { id: string(recording[1]?.[0]), timeline, time, play: recording[5]?.[0] ?? null, ends };
  });
  return { active: string(state[2]?.[0]), recordings };
}

export function closeRecordings(ids) {
  const list = ids.flatMap((id) => field(1, id));
  return new Uint8Array(field(1, field(1 + 2, list)));
}

// A cursor that follows has no time of its own: given one, the viewer would be paused there.
export function setTimeCursor(id, timeline, time, play) {
  const place = play === FOLLOWING ? [] : field(3, field(1, time));
  const request = [...field(1, id), ...field(2, field(1, timeline)), ...place, ...field(5, play)];
  return new Uint8Array(field(6, request));
}

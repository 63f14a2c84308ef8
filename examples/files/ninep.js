// A client of the file server, as much of 9P2000.L as a component needs. See docs/syncfs.md.
'use strict';
const net = require('net');

const text = (s) => { const b = Buffer.from(s); const n = Buffer.alloc(2); n.writeUInt16LE(b.length); return Buffer.concat([n, b]); };
const u = (bytes, value) => { const b = Buffer.alloc(bytes); b.writeUIntLE(value, 0, Math.min(bytes, 6)); return b; };
const NOFID = 0xffffffff;

// An address is that of `fairway serve`: unix:PATH or tcp:HOST:PORT.
exports.connect = async function (address, token) {
  const [kind, a, b] = address.split(':');
  const sock = kind === 'unix' ? net.connect(a) : net.connect({ host: a, port: Number(b), noDelay: true });
  await new Promise((resolve, reject) => { sock.once('connect', resolve); sock.once('error', reject); });
  const asked = []; // replies come in the order of the requests: there is one at a time
  let got = Buffer.alloc(0);
  sock.on('data', (data) => {
    got = Buffer.concat([got, data]);
    while (got.length >= 4 && got.length >= got.readUInt32LE(0)) {
      const reply = got.subarray(4, got.readUInt32LE(0));
      got = got.subarray(got.readUInt32LE(0));
      const { resolve, reject } = asked.shift();
      if (reply[0] === 7) reject(new Error(`errno ${reply.readUInt32LE(3)}`)); else resolve(reply.subarray(3));
    }
  });
  sock.on('close', () => asked.splice(0).forEach(({ reject }) => reject(new Error('the file server is gone'))));
  const call = (type, ...parts) => new Promise((resolve, reject) => {
    const body = Buffer.concat(parts);
    asked.push({ resolve, reject });
    sock.write(Buffer.concat([u(4, 7 + body.length), u(1, type), u(2, type === 100 ? 0xffff : 1), body]));
  });
  const piece = (await call(100, u(4, 65536), text('9P2000.L'))).readUInt32LE(0) - 24;
  await call(104, u(4, 0), u(4, NOFID), text(''), text(token), u(4, NOFID)); // attach
  let fids = 0;
  const walked = async (path, flags) => {
    const names = path.split('/').filter(Boolean), fid = ++fids;
    await call(110, u(4, 0), u(4, fid), u(2, names.length), ...names.map(text));
    if (flags !== undefined) await call(12, u(4, fid), u(4, flags)); // open
    return fid;
  };
  return {
    // A file that stays open: `wait` (of a clock) until its next edge, `read` a revision, `write` the next.
    open: async (path, mode) => {
      const fid = await walked(path, { clock: undefined, read: 0, write: 1 }[mode]);
      return {
        wait: async () => Number((await call(24, u(4, fid), u(8, 0x3fff))).readBigUInt64LE(145)),
        read: async () => (await call(116, u(4, fid), u(8, 0), u(4, piece))).subarray(4).toString(),
        write: (data) => { const b = Buffer.from(data); return call(118, u(4, fid), u(8, 0), u(4, b.length), b); },
      };
    },
    close: () => sock.destroy(),
  };
};

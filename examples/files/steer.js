// Be the component `follow`: steer from way-point to way-point of parking-lot/square. Usage: node steer.js ADDRESS TOKEN
'use strict';
const waypoints = [[15, -15], [15, 15], [-15, 15], [-15, -15]];

(async () => {
  const fs = await require('./ninep').connect(process.argv[2], process.argv[3]);
  const [clock, status, mine] = [await fs.open('follow/clock', 'clock'), await fs.open('localise/status', 'read'), await fs.open('follow/status', 'write')];
  for (let k = 0; await clock.wait();) { // done with this cycle; now it is the next
    const { pose } = JSON.parse(await status.read());
    if (!pose) continue;
    if (k < 4 && Math.hypot(waypoints[k][0] - pose.x_m, waypoints[k][1] - pose.y_m) < 3.2) k++;
    const [x, y] = waypoints[Math.min(k, 3)], turn = Math.atan2(y - pose.y_m, x - pose.x_m) - pose.yaw_rad;
    const steer_rad = Math.max(-0.46, Math.min(0.46, Math.atan2(Math.sin(turn), Math.cos(turn))));
    const speed_mps = k === 4 ? 0 : Math.abs(steer_rad) < 0.2 ? 3 : 2;
    await mine.write(JSON.stringify({ drive: { speed_mps, steer_rad, decel_mps2: 1 }, state: { finished: k === 4 } }));
  }
})().catch((error) => { console.error(error.message); process.exit(1); });

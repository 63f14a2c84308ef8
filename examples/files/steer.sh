#!/bin/sh
# Be the component `follow`: steer from way-point to way-point of parking-lot/square. Usage: steer.sh MOUNT_POINT
# The arithmetic is busybox awk's, which knows no sines; the protocol is the `while` loop.
steer='
    function of(key) { match($0, "\"" key "\":[-0-9.e]+"); return substr($0, RSTART + length(key) + 3, RLENGTH) + 0 }
    function sine(a, q) { q = a * a; return a * (1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72 * (1 - q / 110))))) }
    { split("15 15 -15 -15", x); split("-15 15 15 -15", y); yaw = of("yaw_rad") # of the pose, which comes first
      dx = x[k] - of("x_m"); dy = y[k] - of("y_m"); if (dx * dx + dy * dy < 10 && k < 5) k++
      s = sine(yaw); c = sine(1.5708 - (yaw < 0 ? -yaw : yaw)); ahead = dx * c + dy * s; left = dy * c - dx * s
      a = ahead > 0 ? left / ahead : left < 0 ? -9 : 9; a = a > .46 ? .46 : a < -.46 ? -.46 : a
      printf("%d {\"drive\": {\"speed_mps\": %g, \"steer_rad\": %.4f, \"decel_mps2\": 1}, \"state\": {\"finished\": %s}}",
          k, (k > 4 ? 0 : a * a < .04 ? 3 : 2), a, (k > 4 ? "true" : "false")) }'
cd "$1" || exit 1
k=1                                       # the way-point ahead
while stat -t follow/clock >/dev/null; do # done with this cycle; now it is the next
    out=$(awk -v k="$k" "$steer" localise/status) || break
    k=${out%% *}
    echo "${out#* }" >follow/status
done

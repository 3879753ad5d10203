<?php
// probe.php URL: five samples of a soil probe behind an Arduino with StandardFirmata, in volts, one a line; nothing if it is
// silent. URL is as everywhere in the garden: /dev/ttyACM0?pin=0, or socket://HOST:PORT?pin=0 for a simulated board.

[$device, $query] = explode('?', $argv[1]) + [1 => ''];
$pin = preg_match('/\bpin=(\d+)/', $query, $found) ? (int) $found[1] : 0;
if (str_starts_with($device, 'socket://')) {
    $board = @stream_socket_client('tcp://' . substr($device, 9), $_, $_, 2.0) ?: exit;
} else {
    exec('stty -F ' . escapeshellarg($device) . ' 57600 raw -echo -hupcl');
    $board = @fopen($device, 'r+b') ?: exit;
    sleep(2);   // a board that restarts when it is opened needs two seconds
}
stream_set_blocking($board, false);
// "Report analog channel PIN" five times, each answered with a conversion; then "report it no more".
fwrite($board, str_repeat(chr(0xC0 | $pin) . "\x01", 5) . chr(0xC0 | $pin) . "\x00");
$heard = '';
$until = microtime(true) + 2.0;
$message = sprintf('/\x%02X([\x00-\x7F])([\x00-\x7F])/', 0xE0 | $pin);
while (preg_match_all($message, $heard, $found) < 5 && ($left = $until - microtime(true)) > 0) {
    [$read, $write, $except] = [[$board], null, null];
    if (!stream_select($read, $write, $except, 0, (int) (1e6 * min($left, 0.9)))) continue;
    $heard .= fread($board, 256);
    if (feof($board)) break;
}
for ($i = 0; $i < min(5, count($found[1])); $i++) printf("%.4f\n", (ord($found[1][$i]) + 128 * ord($found[2][$i])) * 5.0 / 1024.0);

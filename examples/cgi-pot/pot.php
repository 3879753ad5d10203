<?php
// What is outside the market: settings, the garden's time, the durable state, tokens.

require __DIR__ . '/market.php';

function settings(): array
{
    static $set = null;
    if ($set !== null) return $set;
    $set = parse_ini_file(getenv('POT_INI') ?: __DIR__ . '/pot.ini', false, INI_SCANNER_TYPED) ?: exit("cannot read pot.ini\n");
    foreach (['data', 'keys', 'peers'] as $path) {
        if ($set[$path][0] !== '/') $set[$path] = __DIR__ . '/' . $set[$path];
    }
    foreach (['stem' => ['x_m', 'y_m', 'z_m'], 'dock' => ['x_m', 'y_m', 'yaw_rad'], 'nozzle' => ['x_m', 'y_m', 'z_m']] as $place => $names) {
        $set[$place] = array_combine($names, array_map('floatval', explode(' ', $set[$place])));
    }
    return $set;
}

// The garden's time [s]: a simulated world's, or this machine's.
function now_s(): float
{
    if (!($url = settings()['clock'])) return microtime(true);
    $wait = stream_context_create(['http' => ['timeout' => 1.0]]);
    $told = @file_get_contents("$url/clock", false, $wait);
    return json_decode((string) $told, true)['garden_s'] ?? throw new Refusal(503, "the garden's clock does not answer");
}

// Run one event on the state under the lock. What it changed is durable before its answer is returned.
function event(Closure $event): mixed
{
    $folder = settings()['data'];
    is_dir($folder) || mkdir($folder, 0755, true);
    $lock = fopen("$folder/lock", 'c');
    flock($lock, LOCK_EX);
    $before = load($folder);
    $market = new Market($before, now_s(), settings());
    try {
        return $event($market);
    } finally {
        if ($market->s !== $before) save($folder, $market->s);
        fclose($lock);
    }
}

// No file: a new pot. A file that cannot be read is not a new pot.
function load(string $folder): array
{
    if (!file_exists("$folder/state.json")) return FRESH;
    return json_decode((string) file_get_contents("$folder/state.json"), true) ?? throw new Refusal(507, 'the state cannot be read');
}

// Written beside it, synced, renamed, and the folder synced: whole or not at all.
function save(string $folder, array $state): void
{
    $file = fopen("$folder/state.tmp", 'w');
    $json = json_encode($state, JSON_THROW_ON_ERROR | JSON_PRESERVE_ZERO_FRACTION);
    $written = $file && fwrite($file, $json) === strlen($json) && fsync($file) && fclose($file);
    if (!$written || !rename("$folder/state.tmp", "$folder/state.json")) throw new Refusal(507, 'the disk refuses');
    exec('sync ' . escapeshellarg($folder), $_, $failed);   // PHP cannot open a folder
    if ($failed) throw new Refusal(507, 'the disk refuses');
}

function unbase64(string $text): string { return (string) base64_decode(strtr($text, '-_', '+/'), true); }

// [subject, role] of a token of this garden (docs/protocol.md, section 3); null for anything else.
function caller(string $token): ?array
{
    $parts = explode('.', $token);
    if (count($parts) !== 3 || strlen($token) > 4096) return null;
    $pem = preg_replace('/-----.*?-----|\s/', '', (string) file_get_contents(settings()['keys'] . '/garden.pub'));
    $key = substr(base64_decode($pem), -SODIUM_CRYPTO_SIGN_PUBLICKEYBYTES);
    $signature = unbase64($parts[2]);
    if ((json_decode(unbase64($parts[0]), true)['alg'] ?? '') !== 'EdDSA' || strlen($signature) !== SODIUM_CRYPTO_SIGN_BYTES) return null;
    if (!sodium_crypto_sign_verify_detached($signature, "$parts[0].$parts[1]", $key)) return null;
    $claims = json_decode(unbase64($parts[1]), true);
    $audience = 'garden-' . substr(hash('sha256', $key), 0, 16);
    $alive = is_numeric($claims['exp'] ?? null) && $claims['exp'] > now_s();
    $known = in_array($claims['role'] ?? '', ['plant', 'robot', 'operator', 'viewer'], true) && is_string($claims['sub'] ?? null);
    return $alive && $known && ($claims['aud'] ?? '') === $audience ? [$claims['sub'], $claims['role']] : null;
}

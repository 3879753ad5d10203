<?php
// What the pot does by itself, in three steps between which `tick` carries messages: look, take the bids, hear of the award.
// Messages are printed one a line, split by tabs: what, robot, method, URL, body.

require __DIR__ . '/pot.php';

function robots(): array
{
    $peers = json_decode((string) file_get_contents(settings()['peers']), true) ?? [];
    return array_column(array_filter($peers, fn($peer) => $peer['kind'] === 'robot'), 'url', 'id');
}

function message(string $what, string $robot_id, string $method, string $path, mixed $body = null): void
{
    if (!$url = robots()[$robot_id] ?? null) return;
    $json = $body === null ? '' : json_encode($body, JSON_PRESERVE_ZERO_FRACTION | JSON_UNESCAPED_SLASHES);
    echo implode("\t", [$what, $robot_id, $method, $url . $path, $json]), "\n";
}

// Volts of one sampling -> what they are worth. The curve is the VH400's, in its maker's pieces.
function judged(array $volts): array
{
    if (!$volts) return ['state' => 'down', 'ratio' => null, 'volts' => null, 'why' => 'the probe does not answer'];
    sort($volts);
    $v = $volts[intdiv(count($volts), 2)];
    [$state, $why] = match (true) {
        $v >= 4.95 => ['short', 'shorted to the supply'],
        $v > 3.1 => ['out_of_range', 'more than the probe can give'],
        $v < 0.05 || end($volts) - $volts[0] > 0.25 => ['open', 'is it plugged in and in the soil?'],
        default => ['good', ''],
    };
    $percent = match (true) {
        $v <= 1.1 => 10.0 * $v - 1.0,
        $v <= 1.3 => 25.0 * $v - 17.5,
        $v <= 1.82 => 48.08 * $v - 47.5,
        $v <= 2.2 => 26.32 * $v - 7.89,
        default => 62.5 * $v - 87.5,
    };
    return ['state' => $state, 'ratio' => $state === 'good' ? min(1.0, max(0.0, $percent / 100.0)) : null, 'volts' => $v, 'why' => $why];
}

function look(): void
{
    $volts = array_map('floatval', preg_split('/\s+/', stream_get_contents(STDIN), -1, PREG_SPLIT_NO_EMPTY));
    $todo = event(function ($market) use ($volts) {
        $market->measured(judged($volts));
        return $market->todo();
    });
    foreach ($todo['kills'] as $kill) message('kill', $kill['robot_id'], 'DELETE', "/tasks/{$kill['task_id']}?epoch={$kill['epoch']}");
    if ($todo['ask']) {
        foreach (robots() as $robot_id => $_) message('bid', $robot_id, 'POST', '/bids', $todo['ask']);
    }
    if ($award = $todo['award']) message('award', $award['announcement']['holder'], 'POST', '/tasks', $award);
}

// A line of `messages` in the folder, as [what, robot, method, URL, body].
function sent(string $folder, string $file, string $what): array
{
    $lines = array_map(fn($line) => explode("\t", $line), (array) @file("$folder/$file", FILE_IGNORE_NEW_LINES));
    return array_filter($lines, fn($line) => $line[0] === $what);
}

// Every asked robot's answer; one that is no bid for this task in its own name says nothing.
function bids(string $folder): void
{
    $bids = [];
    foreach (sent($folder, 'messages', 'bid') as [, $robot_id, , , $body]) {
        $task_id = json_decode($body, true)['task_id'];
        $bid = json_decode((string) @file_get_contents("$folder/bid.$robot_id"), true);
        $good = is_array($bid) && ($bid['robot_id'] ?? '') === $robot_id && ($bid['task_id'] ?? '') === $task_id
            && array_key_exists('cost_s', $bid) && maybe(between(0, 1e7))($bid['cost_s']);
        $silent = ['task_id' => $task_id, 'robot_id' => $robot_id, 'cost_s' => null, 'reason' => 'did not answer'];
        $bids[] = $good ? $bid + ['reason' => ''] : $silent;
    }
    if ($award = event(fn($market) => $market->bids($task_id, $bids))) message('award', $award['announcement']['holder'], 'POST', '/tasks', $award);
}

// What came of an award: taken, refused, or silence, after which it is sent again.
function awarded(string $folder): void
{
    foreach ([...sent($folder, 'messages', 'award'), ...sent($folder, 'award', 'award')] as [, $robot_id, , , $body]) {
        $award = json_decode($body, true);
        $status = (int) @file_get_contents("$folder/award.$robot_id.code");
        if ($status < 200 || $status >= 500) continue;
        $why = json_decode((string) @file_get_contents("$folder/award.$robot_id"), true)['detail'] ?? "status $status";
        event(fn($market) => $market->award_answered($award['announcement']['task_id'], $award['epoch'], $status < 300 ? '' : $why));
    }
}

try {
    match ($argv[1]) {
        'look' => look(),
        'bids' => bids($argv[2]),
        'awarded' => awarded($argv[2]),
    };
} catch (Refusal $no) {
    fwrite(STDERR, $no->getMessage() . "\n");
    exit(1);
}

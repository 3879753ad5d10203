<?php
// The pot's HTTP side: every request comes here (lighttpd.conf), is let in or not, and becomes one event of the market.

require __DIR__ . '/pot.php';

const TITLES = [400 => 'Bad request', 401 => 'Unauthorised', 403 => 'Forbidden', 404 => 'Not found', 409 => 'Refused',
    413 => 'Content too large', 422 => 'Unprocessable content', 503 => 'Unavailable', 507 => 'Not durable'];

function answer(int $status, mixed $body): never
{
    http_response_code($status);
    header('Content-Type: ' . ($status < 400 ? 'application/json' : 'application/problem+json'));
    if ($status === 401) header('WWW-Authenticate: Bearer');
    exit($status === 204 ? '' : json_encode($body, JSON_PRESERVE_ZERO_FRACTION | JSON_UNESCAPED_SLASHES | JSON_INVALID_UTF8_SUBSTITUTE));
}

// Who asks: a token of this garden, of one of these roles.
function allow(string ...$roles): array
{
    $caller = caller(preg_replace('/^Bearer /i', '', $_SERVER['HTTP_AUTHORIZATION'] ?? '')) ?? throw new Refusal(401, 'this needs a token of this garden');
    if (!in_array($caller[1], $roles, true)) throw new Refusal(403, "$caller[0] is a $caller[1]; this takes: " . implode(', ', $roles));
    return $caller;
}

function document(): mixed
{
    $body = (string) file_get_contents('php://input', length: 65537);
    try {
        return json_decode($body, true, 32, JSON_THROW_ON_ERROR);
    } catch (JsonException $error) {
        if (preg_match('/(^|[:,[])\s*-?(NaN|Infinity)\s*($|[],}])/', $body)) throw new Refusal(422, 'a number is not finite');
        throw new Refusal(400, "the body is not JSON: {$error->getMessage()}");
    }
}

// A robot's document; it speaks for itself only.
function of_robot(callable $check): array
{
    [$name] = allow('robot');
    $document = $check(document());
    if ($document['robot_id'] !== $name) throw new Refusal(403, "$name cannot speak for {$document['robot_id']}");
    return $document;
}

function handle(string $method, string $path): never
{
    $id = '[A-Za-z0-9][A-Za-z0-9._:-]{0,79}';
    $key = $_SERVER['HTTP_IDEMPOTENCY_KEY'] ?? '';
    if (strlen($key) > 128) throw new Refusal(422, 'the Idempotency-Key is longer than 128 characters');
    $is = fn(string $pattern, ?array &$found = null) => preg_match("~^$pattern$~D", "$method $path", $found) === 1;
    match (true) {
        $is('GET /healthz') => answer(200, ['status' => 'ok']),
        $is('GET /') => answer(200, event(node_card(...))),
        $is('GET /readyz') => answer(200, event(ready(...))),
        $is('GET /state') => answer(200, event(fn($market) => $market->state())),
        $is('GET /dock') => answer(200, event(fn($market) => $market->docks())),
        $is('GET /tasks') => answer(200, event(fn($market) => $market->tasks())),
        $is("GET /tasks/($id)", $at) => answer(200, event(fn($market) => $market->task($at[1]))),
        $is("POST /tasks/($id)/reports", $at) => reported($at[1], of_robot('report_of')),
        $is("POST /tasks/($id)/permits", $at) => permitted($at[1], of_robot('permit_request_of'), $key),
        $is('POST /dock/reservations') => reserved(of_robot('reservation_request_of')),
        $is("DELETE /dock/reservations/($id)", $at) => given_back($at[1], ...allow('robot', 'operator')),
        $is('POST /tasks') => asked(allow('operator')[0], task_request_of(document())),
        $is("DELETE /tasks/($id)", $at) => called_off($at[1], allow('operator')[0]),
        $method !== 'GET' && !allow('plant', 'robot', 'operator', 'viewer') => null,
        default => throw new Refusal(404, "this pot has no $method $path"),
    };
}

function node_card(Market $market): array
{
    $card = $market->card();
    $links = ['state' => '/state', 'tasks' => '/tasks', 'dock' => '/dock'];
    $place = array_intersect_key($card, ['stem' => 0, 'dock' => 0, 'nozzle' => 0]);
    return ['id' => $card['plant_id'], 'kind' => 'plant', 'capabilities' => ['water'], 'place' => $place, 'links' => $links];
}

function ready(Market $market): array
{
    if ($market->s['soil']['state'] === 'unknown') throw new Refusal(503, 'the soil has not been measured yet');
    return ['ready' => true];
}

function reported(string $id, array $in): never { answer(200, event(fn($market) => $market->report($id, $in))); }
function permitted(string $id, array $in, string $key): never { answer(200, event(fn($market) => $market->permit($id, $in, $key))); }
function reserved(array $in): never { answer(200, event(fn($market) => $market->reserve($in))); }
function asked(string $by, array $in): never { answer(201, event(fn($market) => $market->ask($in, $by))); }
function called_off(string $id, string $by): never { answer(200, event(fn($market) => $market->cancel($id, $by))); }
function given_back(string $id, string $name, string $role): never
{
    event(fn($market) => $market->release_dock($id, $role === 'robot' ? $name : ''));
    answer(204, null);
}

try {
    handle($_SERVER['REQUEST_METHOD'], $_SERVER['PATH_INFO'] ?? '/');
} catch (Refusal $no) {
    answer($no->status, ['title' => TITLES[$no->status], 'status' => $no->status, 'detail' => sentence($no->getMessage())]);
}

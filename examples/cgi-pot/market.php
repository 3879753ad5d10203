<?php
// A pot's side of the market, docs/protocol.md sections 4 to 6: for water alone, one open task at a time.
// Nothing here reads, writes or waits: the state comes in, is changed, and the caller makes it durable before it answers.

const LEASE_S = 8.0;
const VALID_S = 15.0;
const FLOW_MLPS_MIN = 5.0;
const DOSE_ML_MIN = 5.0;
const DAY_S = 86400.0;
const OPEN_STATES = ['announced', 'awarded', 'running'];
const FRESH = [
    'number' => 0, 'thirsty' => false, 'measured_s' => 0.0, 'same' => 0, 'task' => null, 'ended' => [], 'permit' => null,
    'soil' => ['state' => 'unknown', 'ratio' => null, 'volts' => null, 'why' => 'not measured yet'],
    'doses' => [], 'kills' => [], 'dock' => ['robot_id' => '', 'epoch' => 0, 'until_s' => 0.0, 'wanted_by' => '', 'wanted_s' => 0.0],
];
// Of the open task, beside its document: what nobody else need know.
const LIVE = ['lease_until_s' => 0.0, 'next_ask_s' => 0.0, 'backoff_s' => 0.0, 'heard' => false, 'failures' => 0, 'told' => '', 'cost_s' => 0.0];

class Refusal extends Exception
{
    public function __construct(public int $status, string $why) { parent::__construct($why); }
}

class Market
{
    // $s is the whole durable state; $now_s the garden's time; $set the settings.
    public function __construct(public array $s, private float $now_s, private array $set) {}

    // ---- what others read

    public function card(): array
    {
        return ['plant_id' => $this->set['id'], 'url' => "http://127.0.0.1:{$this->set['port']}", 'stem' => $this->set['stem'],
            'dock' => $this->set['dock'], 'nozzle' => $this->set['nozzle']];
    }

    public function state(): array
    {
        $keys = ['threshold_ratio', 'target_ratio', 'dose_ml', 'day_cap_ml', 'soak_s'];
        return ['plant_id' => $this->set['id'], 'now_s' => $this->now_s, 'thirsty' => $this->s['thirsty'], 'card' => $this->card(),
            'soil' => $this->s['soil'] + ['age_s' => max(0.0, $this->now_s - $this->s['measured_s'])],
            'settings' => array_intersect_key($this->set, array_flip($keys)) + ['inventory' => false, 'harvest' => false],
            'open_tasks' => $this->s['task'] ? [$this->s['task']['task_id']] : [], 'watered_today_ml' => $this->given_ml(),
            'dock_holder' => $this->dock_holder(), 'waiting' => sentence($this->waiting())];
    }

    public function tasks(): array
    {
        return [...$this->s['ended'], ...($this->s['task'] ? [$this->s['task']] : [])];
    }

    public function task(string $id): array
    {
        foreach ($this->tasks() as $task) {
            if ($task['task_id'] === $id) return $task;
        }
        throw new Refusal(404, "{$this->set['id']} has no task $id");
    }

    public function docks(): array
    {
        return [['dock_id' => $this->set['id'], 'pose' => $this->set['dock'], 'holder' => $this->dock_holder()]];
    }

    private function dock_holder(): string
    {
        return $this->s['dock']['until_s'] > $this->now_s ? $this->s['dock']['robot_id'] : '';
    }

    private function waiting(): string
    {
        if ($this->s['permit']) return sprintf('measuring again in %.0f s', max(0.0, $this->s['permit']['settle_at_s'] - $this->now_s));
        return $this->unmeasured() ? "not watering: {$this->unmeasured()}" : $this->s['live']['told'] ?? '';
    }

    // ---- soil: called by the tick

    // A judged reading. Afterwards `todo` tells what is to be sent.
    public function measured(array $soil): void
    {
        $this->s['same'] = $soil['volts'] === $this->s['soil']['volts'] ? $this->s['same'] + 1 : 0;
        if ($this->s['same'] >= 60) $soil = ['state' => 'stuck', 'ratio' => null, 'why' => 'its reading does not move at all'] + $soil;
        $this->s['soil'] = $soil;
        $this->s['measured_s'] = $this->now_s;
        if ($soil['ratio'] !== null) {
            $this->s['thirsty'] = $soil['ratio'] < $this->set[$this->s['thirsty'] ? 'target_ratio' : 'threshold_ratio'];
        }
        $this->settle();
        $this->lapse();
        $this->want();
    }

    public function todo(): array
    {
        [$task, $live, $kills] = [$this->s['task'], $this->s['live'] ?? LIVE, $this->s['kills']];
        $this->s['kills'] = [];
        $asks = $task && $task['state'] === 'announced' && !$this->s['permit'] && $this->now_s >= $live['next_ask_s'];
        $awards = $task && $task['state'] === 'awarded' && !$live['heard'];
        return ['kills' => $kills, 'ask' => $asks ? $this->announcement() : null, 'award' => $awards ? $this->award() : null];
    }

    // The permit's dose must have arrived by now: has it?
    private function settle(): void
    {
        $permit = $this->s['permit'];
        $ratio = $this->s['soil']['ratio'];
        if (!$permit || $ratio === null || $this->now_s < $permit['settle_at_s']) return;
        $this->s['permit'] = null;
        $seen = sprintf('soil went from %.3f to %.3f', $permit['before_ratio'], $ratio);
        if (($this->s['task']['task_id'] ?? '') !== $permit['task_id']) return;
        $this->s['task']['permit_id'] = '';
        $this->s['task']['delivered_ml'] = $permit['delivered_ml'] ?? $permit['dose_ml'];
        $needed = min(0.01, max(0.004, 0.2 * $permit['dose_ml'] / 3000.0));
        if ($ratio - $permit['before_ratio'] >= $needed || $ratio >= $this->set['target_ratio']) {
            $this->finish('done', $seen);
        } elseif ($this->s['task']['permits'] >= 3) {
            $this->finish('failed', "$seen after three doses: look at nozzle, tank and probe");
        } else {
            $this->release("$seen: the dose did not arrive, asking again", false);
        }
    }

    private function lapse(): void
    {
        $task = $this->s['task'];
        if (!$task || $task['state'] === 'announced' || $this->now_s < $this->s['live']['lease_until_s']) return;
        if ($this->s['permit']['finished'] ?? false) return;
        $this->kill();
        if ($this->s['permit']) {
            $this->tell("{$task['robot_id']} fell silent under a permit: measuring before anything else");
            $this->s['live']['lease_until_s'] = INF_S;
        } else {
            $this->release("{$task['robot_id']} fell silent", false);
        }
    }

    private function want(): void
    {
        $failed = array_filter($this->s['ended'], fn($task) => $task['state'] === 'failed' && $this->now_s < $task['updated_s'] + 1800.0);
        $idle = !$this->s['task'] && !$this->s['permit'] && !$failed && !$this->unmeasured() && $this->left_ml() >= DOSE_ML_MIN;
        if ($this->s['thirsty'] && $idle) {
            $why = sprintf('water content %.3f is below %.3f', $this->s['soil']['ratio'], $this->set['threshold_ratio']);
            $this->create('soil', $why, $this->set['dose_ml'], 5);
        } elseif (!$this->s['thirsty'] && ($this->s['task']['asked_by'] ?? '') === 'soil' && !$this->s['permit']) {
            $this->kill();
            $this->finish('cancelled', 'moist again');
        }
    }

    private function unmeasured(): string
    {
        if ($this->s['soil']['ratio'] === null) return "the soil probe is {$this->s['soil']['state']}: {$this->s['soil']['why']}";
        $age_s = $this->now_s - $this->s['measured_s'];
        return $age_s > 60.0 ? sprintf('the last measurement is %.0f s old', $age_s) : '';
    }

    private function given_ml(): float
    {
        return (float) array_sum(array_column(array_filter($this->s['doses'], fn($dose) => $dose['t_s'] > $this->now_s - DAY_S), 'ml'));
    }

    private function left_ml(): float { return $this->set['day_cap_ml'] - $this->given_ml(); }

    // ---- rounds and awards: called by the tick

    private function announcement(): array
    {
        $task = $this->s['task'];
        return ['task_id' => $task['task_id'], 'kind' => 'water', 'plant' => $this->card(), 'dose_ml' => $task['dose_ml'],
            'priority' => $task['priority'], 'holder' => $task['robot_id']];
    }

    private function award(): array
    {
        $live = $this->s['live'];
        return ['announcement' => $this->announcement(), 'epoch' => $this->s['task']['epoch'], 'lease_s' => LEASE_S, 'cost_s' => $live['cost_s']];
    }

    // The cheapest wins, ties by id. Its epoch is durable before the award leaves; null when nobody can.
    public function bids(string $id, array $bids): ?array
    {
        if (($this->s['task']['task_id'] ?? '') !== $id || $this->s['task']['state'] !== 'announced') return null;
        $able = array_filter($bids, fn($bid) => $bid['cost_s'] !== null);
        usort($able, fn($a, $b) => [$a['cost_s'], $a['robot_id']] <=> [$b['cost_s'], $b['robot_id']]);
        if (!$able) {
            $this->nobody($bids);
            return null;
        }
        [$robot_id, $cost_s] = [$able[0]['robot_id'], $able[0]['cost_s']];
        $why = sprintf('cheapest of %d: %.1f s', count($bids), $cost_s);
        $this->s['task'] = ['state' => 'awarded', 'robot_id' => $robot_id, 'epoch' => $this->s['task']['epoch'] + 1] + $this->s['task'];
        $this->round($bids, $robot_id, $why);
        $this->s['live'] = ['lease_until_s' => $this->now_s + LEASE_S, 'cost_s' => $cost_s, 'failures' => $this->s['live']['failures']] + LIVE;
        $this->tell("awarded to $robot_id, epoch {$this->s['task']['epoch']}: $why");
        return $this->award();
    }

    private function nobody(array $bids): void
    {
        $why = implode('; ', array_map(fn($bid) => "{$bid['robot_id']}: {$bid['reason']}", $bids)) ?: 'no robot is known';
        if ($why !== $this->s['live']['told']) {
            $this->round($bids, '', $why);
            $this->tell("nobody can take it: $why");
        }
        $backoff_s = min(8.0, max(1.0, 2.0 * $this->s['live']['backoff_s']));
        $this->s['live'] = ['told' => $why, 'backoff_s' => $backoff_s, 'next_ask_s' => $this->now_s + $backoff_s] + $this->s['live'];
    }

    private function round(array $bids, string $winner, string $why): void
    {
        $round = ['t_s' => $this->now_s, 'epoch' => $this->s['task']['epoch'], 'bids' => $bids, 'winner' => $winner, 'why' => sentence($why)];
        $this->s['task']['rounds'] = array_slice([...$this->s['task']['rounds'], $round], -6);
    }

    // The robot took the award, or `$refused` says why not.
    public function award_answered(string $id, int $epoch, string $refused): void
    {
        $task = $this->s['task'];
        if (!$task || [$task['task_id'], $task['epoch'], $task['state']] !== [$id, $epoch, 'awarded']) return;
        if ($refused !== '') $this->release("{$task['robot_id']} refused the award: $refused", true);
        else $this->s['live']['heard'] = true;
    }

    // ---- robots

    public function report(string $id, array $in): array
    {
        $ends = in_array($in['state'], ['done', 'failed']);
        if ($ends && $this->permitted($id, $in) && !$this->s['permit']['finished']) $this->acted($in['delivered_ml'] ?? null);
        $task = $this->task($id);
        $mine = [$task['robot_id'], $task['epoch']] === [$in['robot_id'], $in['epoch']];
        if (!in_array($task['state'], OPEN_STATES)) return ['keep' => $mine && $in['state'] === $task['state'], 'reason' => "$id is {$task['state']}"];
        if (!$mine) return ['keep' => false, 'reason' => "$id is held by {$task['robot_id']} under epoch {$task['epoch']}"];
        $this->s['live'] = ['lease_until_s' => $this->now_s + LEASE_S, 'heard' => true] + $this->s['live'];
        if ($ends) {
            $this->ended($in);
        } else {
            $state = $task['permit_id'] ? 'running' : $in['state'];
            $phase = $in['phase'] ?? '';
            if ([$state, $phase] !== [$task['state'], $task['phase']]) $this->tell($phase ?: $state);
            $this->s['task'] = ['state' => $state, 'phase' => $phase, 'progress' => $in['progress'] ?? 0.0] + $this->s['task'];
        }
        return ['keep' => true, 'lease_s' => LEASE_S];
    }

    private function permitted(string $id, array $in): bool
    {
        $permit = $this->s['permit'];
        return $permit && [$permit['task_id'], $permit['robot_id'], $permit['epoch']] === [$id, $in['robot_id'], $in['epoch']];
    }

    // The permit's holder says that its act is over. Whatever it says, nothing can begin after the validity.
    private function acted(?float $delivered_ml): void
    {
        $permit = &$this->s['permit'];
        $settle_at_s = max($this->now_s, $permit['t_s'] + VALID_S) + $this->set['soak_s'];
        $permit = ['finished' => true, 'delivered_ml' => $delivered_ml, 'settle_at_s' => $settle_at_s] + $permit;
        foreach ($this->s['doses'] as &$dose) {
            if ($dose['permit_id'] === $permit['permit_id']) $dose['ml'] = $delivered_ml ?? $dose['ml'];
        }
    }

    private function ended(array $in): void
    {
        $reason = $in['reason'] ?? '';
        if ($this->permitted($this->s['task']['task_id'], $in)) {
            $phase = 'soaking: the pot measures whether the dose arrived';
            if ($this->s['task']['phase'] !== $phase) $this->tell("{$in['robot_id']} reports {$in['state']} $reason");
            $this->s['task'] = ['phase' => $phase, 'progress' => 1.0] + $this->s['task'];
        } else {
            $why = $in['state'] === 'done' ? 'reports done but took no permit' : "failed: $reason";
            $this->release("{$in['robot_id']} $why", true);
        }
    }

    public function permit(string $id, array $in, string $key): array
    {
        $task = $this->task($id);
        $open = $this->s['permit'];
        if ($key !== '' && $this->permitted($id, $in) && $open['key'] === $key) {
            return ['valid_for_s' => max(0.0, VALID_S - ($this->now_s - $open['t_s']))] + $open['document'];
        }
        $held = [$task['robot_id'], $task['epoch']] === [$in['robot_id'], $in['epoch']] && in_array($task['state'], ['awarded', 'running']);
        match (true) {
            !$held => throw new Refusal(409, "$id is held by {$task['robot_id']} under epoch {$task['epoch']}, {$task['state']}"),
            $this->now_s > $this->s['live']['lease_until_s'] => throw new Refusal(409, "the lease on $id has ended"),
            $in['act'] !== 'water' => throw new Refusal(409, 'a task of kind water does not ' . $in['act']),
            $open !== null => throw new Refusal(409, "permit {$open['permit_id']} is not settled: the pot must measure again first"),
            default => $this->check(),
        };
        $wished_ml = ($in['amount_ml'] ?? 0.0) ?: $task['dose_ml'];
        return $this->issue($task, $key, (float) min($wished_ml, $task['dose_ml'], $this->left_ml()));
    }

    private function check(): void
    {
        if ($why = $this->unmeasured()) throw new Refusal(409, "$why: a dose could not be verified");
        if ($this->left_ml() < DOSE_ML_MIN) throw new Refusal(409, "the day's {$this->set['day_cap_ml']} ml are given");
    }

    private function issue(array $task, string $key, float $ml): array
    {
        $permit_id = sprintf('%s:1:p%d', $this->set['id'], ++$this->s['number']);
        $document = ['permit_id' => $permit_id, 'task_id' => $task['task_id'], 'epoch' => $task['epoch'], 'act' => 'water',
            'dose_ml' => $ml, 'valid_for_s' => VALID_S];
        // Should nobody tell: measure when the act must be over and its water has soaked in.
        $settle_at_s = $this->now_s + VALID_S + $ml / FLOW_MLPS_MIN + 5.0 + $this->set['soak_s'];
        $this->s['permit'] = ['permit_id' => $permit_id, 'task_id' => $task['task_id'], 'robot_id' => $task['robot_id'],
            'epoch' => $task['epoch'], 'key' => $key, 't_s' => $this->now_s, 'dose_ml' => $ml, 'delivered_ml' => null,
            'before_ratio' => $this->s['soil']['ratio'], 'finished' => false, 'settle_at_s' => $settle_at_s, 'document' => $document];
        $today = array_filter($this->s['doses'], fn($dose) => $dose['t_s'] > $this->now_s - DAY_S);
        $this->s['doses'] = [...array_values($today), ['permit_id' => $permit_id, 't_s' => $this->now_s, 'ml' => $ml]];
        $this->s['live']['lease_until_s'] = $this->now_s + LEASE_S;
        $this->s['task'] = ['state' => 'running', 'permit_id' => $permit_id, 'permits' => $task['permits'] + 1] + $this->s['task'];
        $this->tell(sprintf('permit %s for %.0f ml', $permit_id, $ml));
        return $document;
    }

    public function reserve(array $in): array
    {
        $dock = &$this->s['dock'];
        $id = $this->set['id'];
        if (!in_array($in['dock_id'] ?? '', ['', $id], true)) throw new Refusal(404, "$id has no dock {$in['dock_id']}");
        $holder = $this->dock_holder();
        if ($holder !== '' && $holder !== $in['robot_id']) {
            $dock = ['wanted_by' => $in['robot_id'], 'wanted_s' => $this->now_s] + $dock;
            throw new Refusal(409, sprintf('dock %s is held by %s for %.0f s more', $id, $holder, $dock['until_s'] - $this->now_s));
        }
        $for_s = (float) ($in['for_s'] ?? 30.0);
        $epoch = $dock['epoch'] + ($holder === '' ? 1 : 0);
        $wanted = $dock['wanted_by'] !== $in['robot_id'] && $this->now_s - $dock['wanted_s'] < 10.0 ? $dock['wanted_by'] : '';
        $dock = ['robot_id' => $in['robot_id'], 'epoch' => $epoch, 'until_s' => $this->now_s + $for_s, 'wanted_by' => $wanted] + $dock;
        return ['reservation_id' => "$id:$id:$epoch", 'dock_id' => $id, 'robot_id' => $in['robot_id'], 'epoch' => $epoch,
            'valid_for_s' => $for_s, 'wanted_by' => $wanted];
    }

    public function release_dock(string $reservation_id, string $robot_id): void
    {
        $dock = &$this->s['dock'];
        if ($reservation_id !== "{$this->set['id']}:{$this->set['id']}:{$dock['epoch']}" || $this->dock_holder() === '') return;
        if (!in_array($robot_id, ['', $dock['robot_id']], true)) throw new Refusal(403, "$reservation_id is {$dock['robot_id']}'s");
        $dock = ['robot_id' => '', 'until_s' => 0.0] + $dock;
    }

    // ---- people

    public function ask(array $in, string $by): array
    {
        if ($in['kind'] !== 'water') throw new Refusal(409, 'this pot asks for water only');
        if ($this->s['task']) throw new Refusal(409, "{$this->s['task']['task_id']} already asks for water");
        $this->check();
        return $this->create($by, 'asked by hand', (float) ($in['dose_ml'] ?? $this->set['dose_ml']), $in['priority'] ?? 5);
    }

    public function cancel(string $id, string $by): array
    {
        $task = $this->task($id);
        if ($task['state'] === 'cancelled') return $task;
        if (!in_array($task['state'], OPEN_STATES)) throw new Refusal(409, "$id is {$task['state']} already");
        $this->kill();
        $this->finish('cancelled', "cancelled by $by");
        return $this->task($id);
    }

    // ---- a task's life

    private function create(string $by, string $why, float $dose_ml, int $priority): array
    {
        $id = sprintf('%s:1:%d', $this->set['id'], ++$this->s['number']);
        $this->s['task'] = ['task_id' => $id, 'kind' => 'water', 'state' => 'announced', 'plant_id' => $this->set['id'],
            'robot_id' => '', 'epoch' => 0, 'created_s' => $this->now_s, 'updated_s' => $this->now_s, 'asked_by' => $by, 'why' => $why,
            'priority' => $priority, 'dose_ml' => $dose_ml, 'delivered_ml' => null, 'phase' => '', 'progress' => 0.0, 'reason' => '',
            'permit_id' => '', 'permits' => 0, 'rounds' => [], 'events' => []];
        $this->s['live'] = ['next_ask_s' => $this->now_s] + LIVE;
        $this->tell("asked for by $by: $why");
        return $this->s['task'];
    }

    private function tell(string $what): void
    {
        $task = &$this->s['task'];
        $event = ['t_s' => $this->now_s, 'what' => sentence($what), 'robot_id' => $task['robot_id'], 'epoch' => $task['epoch']];
        $task = ['updated_s' => $this->now_s, 'events' => array_slice([...$task['events'], $event], -40)] + $task;
    }

    // Back to the market; failed for good after eight times.
    private function release(string $why, bool $failed): void
    {
        $failures = $this->s['live']['failures'] + ($failed ? 1 : 0);
        $this->tell($why);
        if ($failures >= 8) {
            $this->finish('failed', "$why ($failures failures)");
            return;
        }
        $this->s['task'] = ['state' => 'announced', 'robot_id' => '', 'phase' => '', 'progress' => 0.0, 'reason' => sentence($why)] + $this->s['task'];
        $this->s['live'] = ['failures' => $failures, 'next_ask_s' => $this->now_s + ($failed ? min(30.0, 2.0 ** ($failures - 1)) : 0.0)] + LIVE;
    }

    private function kill(): void
    {
        $task = $this->s['task'];
        if ($task['robot_id'] !== '') $this->s['kills'][] = ['robot_id' => $task['robot_id'], 'task_id' => $task['task_id'], 'epoch' => $task['epoch']];
    }

    private function finish(string $state, string $why): void
    {
        $this->tell("$state: $why");
        $ended = ['state' => $state, 'phase' => '', 'reason' => sentence($why)] + $this->s['task'];
        $this->s['ended'] = array_slice([...$this->s['ended'], $ended], -20);
        $this->s['task'] = null;
    }
}

// Sentences on the wire have at most 500 characters.
function sentence(string $text): string
{
    return preg_match('/^.{0,500}/us', $text, $found) ? $found[0] : '';
}

const INF_S = 1e12;

// ---- documents: these fields, of these kinds, and no others

function text(mixed $value): bool { return is_string($value) && preg_match('/^.{0,500}$/us', $value) === 1; }
function whole(mixed $value): bool { return is_int($value) && $value >= 0; }
function between(float $least, float $most): Closure
{
    return fn($value) => (is_int($value) || is_float($value)) && $value >= $least && $value <= $most;
}
function one_of(string ...$words): Closure { return fn($value) => in_array($value, $words, true); }
function maybe(callable $kind): Closure { return fn($value) => $value === null || $kind($value); }

// The document as it is, or 422. `$must` and `$may` name the fields and what each has to be.
function checked(mixed $document, array $must, array $may): array
{
    if (!is_array($document) || ($document && array_is_list($document))) throw new Refusal(422, 'not an object');
    if ($more = array_diff_key($document, $must, $may)) throw new Refusal(422, 'unknown fields: ' . implode(', ', array_keys($more)));
    if ($less = array_diff_key($must, $document)) throw new Refusal(422, 'missing: ' . implode(', ', array_keys($less)));
    foreach ($document as $name => $value) {
        if (!($must + $may)[$name]($value)) throw new Refusal(422, "$name is not what it should be");
    }
    return $document;
}

function report_of(mixed $document): array
{
    return checked($document,
        ['robot_id' => 'text', 'epoch' => 'whole', 'state' => one_of('awarded', 'running', 'done', 'failed')],
        ['phase' => 'text', 'progress' => between(0, 1), 'reason' => 'text', 'delivered_ml' => maybe(between(0, 1e6)), 'picks' => 'is_array']);
}

function permit_request_of(mixed $document): array
{
    return checked($document, ['robot_id' => 'text', 'epoch' => 'whole', 'act' => one_of('water', 'pick')],
        ['amount_ml' => between(0, 500), 'fruit_id' => 'text']);
}

function reservation_request_of(mixed $document): array
{
    return checked($document, ['robot_id' => 'text'], ['dock_id' => 'text', 'for_s' => between(0.001, 600), 'yielding' => 'is_bool']);
}

function task_request_of(mixed $document): array
{
    return checked($document, ['kind' => one_of('water', 'inventory', 'harvest')],
        ['dose_ml' => maybe(between(0.001, 500)), 'priority' => fn($value) => whole($value) && $value <= 9]);
}

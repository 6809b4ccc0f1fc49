/* Steps of many rows in one pass: what `dynamics` computes with tensors, bit for bit; and two of its parts alone.

   `kernel.py` compiles this file. `native` packs the parameters, checks the arguments and calls `ctgraph_run`. Rows are
   run in blocks: the state of a block stays in the cache through all steps, and the draws of its rows are made in loops
   that compilers vectorize. Every row is computed alone, so blocks and threads do not change its bits. Nothing is written
   beyond the arrays of a call whatever their values, and nothing read beyond the tables: states that no task can have
   are counted instead. Overflow wraps as in torch (-fwrapv); products are never fused with sums (-ffp-contract=off). */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { HOME, WAIT, DECISION, END, FAIL };
enum { STREAM_STEP, STREAM_NOISE, STREAM_IMAGES, STREAM_REWARD, STREAM_GOAL };
enum { NEEDLE, GRADIENT, REFERENCE_LINEAR };
enum { BLOCK = 64, NUMBERS = 64 };
#define WORD 0xFFFFFFFFu

/* One of the different tasks, in the order of `native._packed`; every field has eight bytes. */
typedef struct {
    int64_t branching_factor, first_leaf, stay_below, extra_end_step, swap_node, swap_first, swap_second;
    int64_t num_views, num_angles, read_noise, reward_cue, cue_wraps, cue_element, noise_start;
    double white;
    int64_t depth, num_leaves, reward_fn, multiplicative, change_first, change_last, legacy_change;
    double goal_reward, fail_reward, step_reward, reward_std;
    int64_t first_view[5], views_per_node[5], num_ids[5], legacy_ids[5];
} Task;

/* The fields of `dynamics.RowState`, [N] each. */
typedef struct {
    uint8_t *kind;
    int64_t *node, *tick, *step_count;
    float *episode_reward;
    int64_t *goal_leaf, *episodes_left;
    float *reward, *paid;
} State;

/* The fields of `native._Call`. */
typedef struct {
    int64_t num_rows, num_steps, num_threads;
    int64_t num_tasks, bank_rows, num_pixels, width, is_vector, num_levels;
    int64_t draws, pixel_noise, noise_bank, reward_noise, fail_reward, step_reward, goal_change;
    int64_t own_seeds; /* a seed for each row, else one for all */
    int64_t restarts;  /* rows that a step finishes start an episode within it */
    int64_t most_action; /* actions beyond it are counted, and steps of rows that are over; -1: none is */
    const Task *tasks;
    const int64_t *task, *seed, *row;
    const uint8_t *bank, *noises;
    const double *normal_table;
    const int64_t *level_first, *level_shift; /* [tasks, levels] */
    const int64_t *tap_index, *tap_weight;    /* [angles, pixels, 4], or null */
    State before, after;
    const int64_t *action; /* [T, N], or null for no step */
    const uint8_t *mask;   /* [N], rows that start an episode instead, or null */
    const uint8_t *shown;  /* [N, pixels], what rows that start no episode show, or null to compute it */
    uint8_t *observation;  /* [T, N, pixels], after the restarts, but before them if there is a place for what follows */
    uint8_t *following;    /* [T, N, pixels], after the restarts, or null */
    uint8_t *done, *outcome; /* [T, N] each, or null; before the restarts, as all below */
    int64_t *leaf, *step_count;
    float *reward, *episode_reward;
} Call;

/* The rows of a block: what of their tasks all of them need, the fields of `State`, and draws for their ticks. */
typedef struct {
    int count;
    const Task *task[BLOCK];
    int64_t branching_factor[BLOCK], first_leaf[BLOCK], stay_below[BLOCK], extra_end_step[BLOCK];
    int64_t swap_node[BLOCK], swap_first[BLOCK], swap_second[BLOCK];
    uint64_t seed[BLOCK], number[BLOCK];
    int64_t kind[BLOCK], node[BLOCK], tick[BLOCK], step_count[BLOCK], goal_leaf[BLOCK], episodes_left[BLOCK];
    float episode_reward[BLOCK], reward[BLOCK], paid[BLOCK];
    int64_t pays[BLOCK], over[BLOCK], outcome[BLOCK];
    uint32_t word[4][BLOCK]; /* the small draws, see `dynamics.Words` */
    uint32_t noise[4][BLOCK];
} Block;

/* Philox4x32-10 of a counter and a key, see `philox.philox`. */
static inline void
philox(uint64_t c0, uint64_t c1, uint64_t c2, uint64_t c3, uint64_t k0, uint64_t k1, uint32_t word[4])
{
#pragma GCC unroll 10
    for (int round = 0; round < 10; round++) {
        uint64_t even = c0 * 0xD2511F53u, odd = c2 * 0xCD9E8D57u;
        c0 = (odd >> 32) ^ c1 ^ k0, c1 = odd & WORD;
        c2 = (even >> 32) ^ c3 ^ k1, c3 = even & WORD;
        k0 = (k0 + 0x9E3779B9u) & WORD, k1 = (k1 + 0xBB67AE85u) & WORD;
    }
    word[0] = c0, word[1] = c1, word[2] = c2, word[3] = c3;
}

/* `philox.draw`: of (tick, row, stream), with the key of a seed. */
static inline void draw(uint64_t seed, uint64_t row, uint64_t tick, uint64_t stream, uint32_t word[4])
{
    philox(tick & WORD, tick >> 32, row, stream << 28, seed & WORD, seed >> 32, word);
}

static void draw_all(Block *block, uint64_t stream, uint32_t word[4][BLOCK])
{
    int count = (block->count + 7) / 8 * 8; /* whole vectors */
    for (int j = 0; j < count; j++) {
        uint32_t one[4];
        draw(block->seed[j], block->number[j], block->tick[j], stream, one);
        word[0][j] = one[0], word[1][j] = one[1], word[2][j] = one[2], word[3][j] = one[3];
    }
}

static inline int64_t randint(uint32_t word, int64_t high) { return ((int64_t)word * high) >> 32; }

/* `philox.normal`. */
static double normal(uint32_t word, const double *table)
{
    double tail = (double)(word >> 1) + 0.5;
    int64_t bits;
    memcpy(&bits, &tail, 8);
    int64_t cell = (bits >> 44) - (1022 << 8);
    double place = (double)(bits & (((int64_t)1 << 44) - 1)) * 0x1p-44;
    double size = rint((table[cell] + (table[cell + 1] - table[cell]) * place) / 0x1p-20) * 0x1p-20;
    return word & 1 ? size : -size;
}

/* What the classes of `rewards` give for an end state. */
static float share_of(const Task *task, int64_t leaf, int64_t goal)
{
    if (task->reward_fn == NEEDLE)
        return leaf == goal;
    int64_t b = task->branching_factor, lost = 0, power = 1;
    for (int64_t place = 1; place <= task->depth; place++, power *= b) {
        int64_t difference = llabs(leaf / power % b - goal / power % b);
        lost += difference * (task->reward_fn == GRADIENT ? power : place);
    }
    double most = task->reward_fn == GRADIENT ? (double)(power - 1) : (double)(task->depth * (task->depth + 1) / 2);
    return (float)(1 - (double)lost / most);
}

/* `dynamics._paid` in an end or a fail state. */
static float paid(const Call *call, const Block *block, int j)
{
    const Task *task = block->task[j];
    if (block->kind[j] == FAIL)
        return (float)task->fail_reward;
    float share = share_of(task, block->node[j] - task->first_leaf, block->goal_leaf[j]);
    float paid = share * (float)task->goal_reward;
    if (!call->reward_noise)
        return paid;
    uint32_t word[4];
    draw(block->seed[j], block->number[j], block->tick[j], STREAM_REWARD, word);
    float noise = (float)(normal(word[0], call->normal_table) * task->reward_std);
    return (float)((double)paid + (task->multiplicative ? (double)paid * (double)noise : (double)noise));
}

/* `tree.transition`, for a block at once: no branches, as actions are as good as random. */
static void go(Block *block, const int64_t *action, int64_t pays_failure)
{
#pragma omp simd
    for (int j = 0; j < block->count; j++) {
        int64_t kind = block->kind[j], node = block->node[j], b = block->branching_factor[j], a = action[j];
        int64_t wait = (int64_t)((uint64_t)block->word[0][j] << 31 | block->word[1][j] >> 1);
        int64_t left = wait < block->stay_below[j] ? WAIT : node >= block->first_leaf[j] ? END : DECISION;
        int64_t next = kind == HOME ? (node > 0 ? HOME : WAIT) : FAIL;
        next = (kind == WAIT) & (a == 0) ? left : next;
        int64_t decides = (kind == DECISION) & (a > 0) & (a <= b);
        next = decides ? WAIT : next;
        next = kind == END ? (block->extra_end_step[j] ? HOME : END) : next;
        int64_t first = block->swap_first[j], second = block->swap_second[j];
        int64_t swaps = (node == block->swap_node[j]) & ((a == first) | (a == second));
        block->node[j] = decides ? node * b + (swaps ? first + second - a : a) : node;
        block->kind[j] = next;
        block->pays[j] = (next != kind) & ((next == END) | ((next == FAIL) & pays_failure));
    }
}

/* `dynamics.advance`; the ticks of rows that start an episode instead stay. */
static void advance(const Call *call, Block *block, const int64_t *action, const int64_t *starts)
{
    go(block, action, call->fail_reward != 0);
    for (int j = 0; j < block->count; j++)
        block->paid[j] = block->pays[j] ? paid(call, block, j) : 0;
    for (int j = 0; j < block->count; j++)
        block->reward[j] = block->paid[j];
    for (int j = 0; call->step_reward && j < block->count; j++)
        block->reward[j] = (float)((double)block->paid[j] + block->task[j]->step_reward);
    for (int j = 0; j < block->count; j++) {
        block->tick[j] += 1 - starts[j];
        block->step_count[j] += 1;
        block->episode_reward[j] += block->reward[j];
    }
}

/* `dynamics._count_episode` */
static void count_episode(Block *block, int j)
{
    const Task *task = block->task[j];
    uint32_t word[4];
    draw(block->seed[j], block->number[j], block->tick[j], STREAM_GOAL, word);
    int64_t span = task->change_last - task->change_first + 1;
    int64_t first = task->change_first + randint(word[0], span), second = task->change_first + randint(word[3], span);
    int begins = block->episodes_left[j] == 0;
    block->episodes_left[j] = begins ? first - task->legacy_change : block->episodes_left[j] - 1;
    if (block->episodes_left[j] == 0 && task->change_first > 0) {
        uint64_t wide = (uint64_t)word[1] << 32 | word[2];
        block->goal_leaf[j] = (int64_t)(((unsigned __int128)wide * (uint64_t)task->num_leaves) >> 64);
        block->episodes_left[j] = begins ? second : first;
    }
}

/* `dynamics.begin`. */
static void begin(const Call *call, Block *block, const int64_t *starts)
{
    for (int j = 0; j < block->count; j++) {
        int64_t keeps = starts[j] - 1;
        block->kind[j] &= keeps;
        block->node[j] &= keeps;
        block->tick[j] += starts[j];
        block->step_count[j] &= keeps;
        block->episode_reward[j] = starts[j] ? 0 : block->episode_reward[j];
        block->reward[j] = starts[j] ? 0 : block->reward[j];
        block->paid[j] = starts[j] ? 0 : block->paid[j];
    }
    for (int j = 0; call->goal_change && j < block->count; j++)
        if (starts[j])
            count_episode(block, j);
}

/* A short memcpy without the call. */
static inline void copy(uint8_t *restrict out, const uint8_t *restrict image, int64_t size)
{
    int64_t k = 0;
    for (; k + 64 <= size; k += 64)
        memcpy(out + k, image + k, 64);
    for (; k + 16 <= size; k += 16)
        memcpy(out + k, image + k, 16);
    if (k < size)
        memcpy(out + k, image + k, size - k);
}

/* `reading.noisy`: 16 bits of SplitMix64 for each pixel. */
static void add_noise(uint8_t *restrict out, const uint8_t *restrict image, int64_t size, uint64_t start, uint16_t high)
{
    for (int64_t first = 0; first < size; first += 4 * NUMBERS) {
        int64_t pixels = size - first < 4 * NUMBERS ? size - first : 4 * NUMBERS;
        union {
            uint64_t number[NUMBERS];
            uint16_t bits[4 * NUMBERS];
        } draw;
        for (int64_t k = 0; k < (pixels + 3) / 4; k++) {
            uint64_t z = start + 0x9E3779B97F4A7C15u * (uint64_t)(first / 4 + k + 1);
            z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
            z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
            draw.number[k] = z ^ (z >> 31);
        }
        for (int64_t k = 0; k < pixels; k++) {
            uint16_t sum = image[first + k] + (uint16_t)(((uint32_t)draw.bits[k] * (uint32_t)high) >> 16);
            out[first + k] = sum > 255 ? 255 : sum;
        }
    }
}

/* `reading.add_saturating`. */
static void add_image(uint8_t *restrict out, const uint8_t *restrict image, const uint8_t *restrict noise, int64_t size)
{
    for (int64_t k = 0; k < size; k++) {
        uint16_t sum = image[k] + noise[k];
        out[k] = sum > 255 ? 255 : sum;
    }
}

/* `reading.turn`, in place; how many images could not be turned. */
static int turn(const Call *call, uint8_t *image, int64_t angle)
{
    int64_t size = call->num_pixels;
    uint8_t *source = malloc(size);
    if (!source)
        return 1;
    memcpy(source, image, size);
    const int64_t *index = call->tap_index + angle * size * 4, *weight = call->tap_weight + angle * size * 4;
    for (int64_t k = 0; k < size; k++, index += 4, weight += 4) {
        int64_t sum = 1 << 15;
        for (int tap = 0; tap < 4; tap++)
            sum += source[index[tap]] * weight[tap];
        image[k] = (uint8_t)(sum >> 16);
    }
    free(source);
    return 0;
}

/* `reading.cue_level` and `reading.add_cue`. */
static void add_cue(const Call *call, const Task *task, float paid, uint8_t *image)
{
    double level = trunc((double)paid / task->goal_reward * task->white), white = trunc(task->white);
    if (task->cue_wraps) {
        level = fmod(level, 256);
        level += level < 0 ? 256 : 0;
    } else {
        level = level < 0 ? 0 : level > white ? white : level;
    }
    if (call->is_vector) {
        image[task->cue_element] = (uint8_t)level;
        return;
    }
    int64_t size = call->width, quarter = size / 4;
    for (int64_t y = quarter; y < size - quarter; y++)
        memset(image + y * size + quarter, (uint8_t)level, size - 2 * quarter);
}

/* The number that `Observations.legacy_index` gives a node. */
static int64_t legacy_number(const Call *call, const Task *task, int64_t node)
{
    int64_t start = (task - call->tasks) * call->num_levels, level = 0;
    while (level + 1 < call->num_levels && node >= call->level_first[start + level + 1])
        level++;
    return node + call->level_shift[start + level];
}

/* A noise of the noise bank. */
static const uint8_t *drawn_noise(const Call *call, const Task *task, uint32_t word)
{
    return call->noises + (task->noise_start + randint(word, call->noise_bank)) * call->num_pixels;
}

/* `dynamics.observe`: the image of row j; 1 where the row's state is none of its task. */
static inline int observe(const Call *call, const Block *block, int j, uint8_t *restrict out)
{
    const Task *task = block->task[j];
    int kind = block->kind[j];
    int64_t angle = 0, size = call->num_pixels, node = block->node[j];
    int64_t place = task->first_view[kind] + node * task->views_per_node[kind];
    if (call->num_levels)
        place += legacy_number(call, task, node) % task->legacy_ids[kind] * task->num_views;
    if (call->draws) {
        int64_t view = randint(block->word[3][j], task->num_views * task->num_angles);
        place += randint(block->word[2][j], task->num_ids[kind]) * task->num_views;
        if (task->num_angles > 1)
            angle = view % task->num_angles, view /= task->num_angles;
        place += view;
    }
    if ((uint64_t)place >= (uint64_t)call->bank_rows)
        return 1;
    const uint8_t *image = call->bank + place * size;
    if (call->noise_bank)
        add_image(out, image, drawn_noise(call, task, block->noise[0][j]), size);
    else if (task->read_noise)
        add_noise(out, image, size, (uint64_t)block->noise[0][j] << 32 | block->noise[1][j], task->read_noise + 1);
    else
        copy(out, image, size);
    int wrong = call->tap_index ? turn(call, out, angle) : 0;
    if (kind == END && task->reward_cue)
        add_cue(call, task, block->paid[j], out);
    return wrong;
}

static int load(const Call *call, Block *block, int64_t first)
{
    const State *from = &call->before;
    int n = block->count;
    for (int j = 0; j < n; j++) {
        int64_t i = first + j, task = call->task[i];
        if (from->kind[i] > FAIL || (uint64_t)task >= (uint64_t)call->num_tasks)
            return 1;
        block->task[j] = call->tasks + task;
        block->branching_factor[j] = block->task[j]->branching_factor;
        block->first_leaf[j] = block->task[j]->first_leaf;
        block->stay_below[j] = block->task[j]->stay_below;
        block->swap_node[j] = block->task[j]->swap_node;
        block->swap_first[j] = block->task[j]->swap_first;
        block->swap_second[j] = block->task[j]->swap_second;
        block->extra_end_step[j] = block->task[j]->extra_end_step;
        block->seed[j] = call->seed[call->own_seeds ? i : 0];
        block->kind[j] = from->kind[i];
    }
    memcpy(block->number, call->row + first, n * 8);
    memcpy(block->node, from->node + first, n * 8);
    memcpy(block->tick, from->tick + first, n * 8);
    memcpy(block->step_count, from->step_count + first, n * 8);
    memcpy(block->goal_leaf, from->goal_leaf + first, n * 8);
    memcpy(block->episodes_left, from->episodes_left + first, n * 8);
    memcpy(block->episode_reward, from->episode_reward + first, n * 4);
    memcpy(block->reward, from->reward + first, n * 4);
    memcpy(block->paid, from->paid + first, n * 4);
    return 0;
}

static void store(const Call *call, const Block *block, int64_t first)
{
    const State *to = &call->after;
    int n = block->count;
    for (int j = 0; j < n; j++)
        to->kind[first + j] = block->kind[j];
    memcpy(to->node + first, block->node, n * 8);
    memcpy(to->tick + first, block->tick, n * 8);
    memcpy(to->step_count + first, block->step_count, n * 8);
    memcpy(to->goal_leaf + first, block->goal_leaf, n * 8);
    memcpy(to->episodes_left + first, block->episodes_left, n * 8);
    memcpy(to->episode_reward + first, block->episode_reward, n * 4);
    memcpy(to->reward + first, block->reward, n * 4);
    memcpy(to->paid + first, block->paid, n * 4);
}

/* Whether row j has arrived in an end state and its episode is over. */
static inline int64_t has_arrived(const Block *block, int j)
{
    int64_t kind = block->kind[j];
    return ((kind == END) & !block->extra_end_step[j]) | ((kind == HOME) & (block->node[j] > 0));
}

/* How many actions no task knows, and how many steps are those of rows that are over. */
static int64_t refused(const Call *call, const Block *block, const int64_t *action)
{
    int64_t count = 0;
    for (int j = 0; call->most_action >= 0 && j < block->count; j++)
        count += (uint64_t)action[j] > (uint64_t)call->most_action || block->kind[j] == FAIL || has_arrived(block, j);
    return count;
}

/* Which rows are over, and what they show but their observations. */
static void result(const Call *call, Block *block, int64_t at)
{
    int n = block->count;
    uint8_t done[BLOCK], outcome[BLOCK];
    int64_t leaf[BLOCK];
    for (int j = 0; j < n; j++) {
        int64_t arrived = has_arrived(block, j), place = block->node[j] - block->first_leaf[j];
        block->over[j] = arrived | (block->kind[j] == FAIL);
        block->outcome[j] = block->over[j] + arrived + (arrived & (place == block->goal_leaf[j]));
        leaf[j] = arrived ? place : -1;
    }
    for (int j = 0; j < n; j++)
        done[j] = block->over[j], outcome[j] = block->outcome[j];
    if (call->done)
        memcpy(call->done + at, done, n);
    if (call->outcome)
        memcpy(call->outcome + at, outcome, n);
    if (call->leaf)
        memcpy(call->leaf + at, leaf, n * 8);
    if (call->step_count)
        memcpy(call->step_count + at, block->step_count, n * 8);
    if (call->reward)
        memcpy(call->reward + at, block->reward, n * 4);
    if (call->episode_reward)
        memcpy(call->episode_reward + at, block->episode_reward, n * 4);
}

/* What a block observes, where what rows that start no episode show may be at hand. How many states were none of their
   tasks. */
static int64_t
observe_all(const Call *call, Block *block, const uint8_t *shown, const int64_t *starts, uint8_t *restrict out)
{
    int64_t wrong = 0, size = call->num_pixels, any = !shown;
    for (int j = 0; j < block->count; j++)
        any |= starts[j];
    if (any && call->draws)
        draw_all(block, STREAM_STEP, block->word);
    if (any && call->pixel_noise)
        draw_all(block, STREAM_NOISE, block->noise);
    for (int j = 0; j < block->count; j++, out += size) {
        if (shown && !starts[j])
            copy(out, shown + j * size, size);
        else
            wrong += observe(call, block, j, out);
    }
    return wrong;
}

/* All steps of one block; how many actions were refused and how many states were none of their tasks. */
static int64_t run_block(const Call *call, int64_t first, int count)
{
    Block block = {.count = count};
    int64_t wrong = 0, size = call->num_pixels, starts[BLOCK] = {0};
    const uint8_t *shown = call->shown ? call->shown + first * size : NULL;
    if (load(call, &block, first))
        return 1;
    for (int j = 0; call->mask && j < count; j++)
        starts[j] = call->mask[first + j] != 0;
    if (call->action && call->draws)
        draw_all(&block, STREAM_STEP, block.word);
    for (int64_t t = 0; t < call->num_steps; t++) {
        int64_t at = t * call->num_rows + first;
        uint8_t *seen = call->observation + at * size;
        if (call->action) {
            wrong += refused(call, &block, call->action + at);
            advance(call, &block, call->action + at, starts);
        }
        if (call->mask)
            begin(call, &block, starts);
        result(call, &block, at);
        if (call->following)
            wrong += observe_all(call, &block, shown, starts, seen);
        if (call->restarts)
            begin(call, &block, block.over);
        if (call->following)
            wrong += observe_all(call, &block, seen, block.over, call->following + at * size);
        else
            wrong += observe_all(call, &block, shown, starts, seen);
    }
    store(call, &block, first);
    return wrong;
}

int64_t ctgraph_run(const Call *call)
{
    int64_t wrong = 0, blocks = (call->num_rows + BLOCK - 1) / BLOCK;
#pragma omp parallel for schedule(static) num_threads(call->num_threads) if (call->num_threads > 1) reduction(+ : wrong)
    for (int64_t b = 0; b < blocks; b++) {
        int64_t first = b * BLOCK, rest = call->num_rows - first;
        wrong += run_block(call, first, rest < BLOCK ? rest : BLOCK);
    }
    return wrong;
}

/* Philox of `count` counters and keys: six words each, one for all (step 0) or one each (step 1); out is [4, count]. */
void ctgraph_philox(
    const int64_t *const in[6], const int64_t step[6], int64_t *restrict out, int64_t count, int64_t num_threads)
{
    int64_t blocks = (count + BLOCK - 1) / BLOCK;
#pragma omp parallel for schedule(static) num_threads(num_threads) if (num_threads > 1)
    for (int64_t b = 0; b < blocks; b++) {
        int64_t first = b * BLOCK, rest = count - first, size = rest < BLOCK ? rest : BLOCK;
        uint64_t given[6][BLOCK] = {{0}};
        uint32_t word[4][BLOCK];
        for (int i = 0; i < 6; i++)
            for (int64_t j = 0; j < size; j++)
                given[i][j] = (uint64_t)in[i][(first + j) * step[i]];
        for (int j = 0; j < BLOCK; j++) {
            uint32_t one[4];
            philox(given[0][j], given[1][j], given[2][j], given[3][j], given[4][j], given[5][j], one);
            word[0][j] = one[0], word[1][j] = one[1], word[2][j] = one[2], word[3][j] = one[3];
        }
        for (int i = 0; i < 4; i++)
            for (int64_t j = 0; j < size; j++)
                out[i * count + first + j] = word[i][j];
    }
}

/* `reading.add_noise` for images of `size` pixels. */
void ctgraph_noise(
    uint8_t *restrict out, const uint8_t *restrict image, const int64_t *start, const int64_t *read_noise, int64_t count,
    int64_t size, int64_t num_threads)
{
#pragma omp parallel for schedule(static) num_threads(num_threads) if (num_threads > 1)
    for (int64_t j = 0; j < count; j++)
        add_noise(out + j * size, image + j * size, size, (uint64_t)start[j], (uint16_t)(read_noise[j] + 1));
}

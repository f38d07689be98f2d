/* The rules of a guard, without a node: each error once, silence, and that it stays safe until it is armed again. */
#define _POSIX_C_SOURCE 200809L

#include "expect.h"

#include <stdatomic.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define MS UINT64_C(1000000)

struct torque { float newton_metres; uint32_t number; };

/* The output is a number; the function that makes it safe also runs on a thread of the library. */
struct motor { _Atomic int torque; _Atomic int safe_count; _Atomic int why; _Atomic int fails; };

static int32_t make_safe(void *output, sinew_output_state why)
{
    struct motor *motor = output;
    if (motor->fails > 0) {
        motor->fails--;
        return 1;
    }
    motor->torque = 0;
    motor->why = (int)why;
    motor->safe_count++;
    return 0;
}

static void move(void *output, void *argument)
{
    ((struct motor *)output)->torque = *(int *)argument;
}

static sinew_protected_type torque_type(uint64_t period_ns)
{
    return sinew_protected_type_of(SINEW_TEXT("test.torque"), sizeof(struct torque), period_ns);
}

static const sinew_data_id data_id = { UINT64_C(0x700001001), UINT64_C(0x700001002), { "test.torque", 11 } };

/* A sender that keeps its own counter, and the last message that it sent. */
struct bench {
    sinew_guard *guard;
    struct motor motor;
    sinew_stamp stamp;
    uint8_t sealed[sizeof(struct torque) + SINEW_SEALED_OVERHEAD];
};

static void seal_as(struct bench *bench, const sinew_data_id *name)
{
    struct torque torque = { 2.5f, (uint32_t)bench->stamp.counter };
    EXPECT(sinew_seal(name, &bench->stamp, &torque, sizeof torque, bench->sealed, sizeof bench->sealed) == SINEW_OK);
}

static sinew_sealed_fault take(struct bench *bench, sinew_status wanted)
{
    sinew_sealed_fault fault = -1;
    EXPECT(sinew_check_sealed(bench->guard, bench->sealed, sizeof bench->sealed, &fault) == wanted);
    return fault;
}

static sinew_sealed_fault next(struct bench *bench, sinew_status wanted)
{
    EXPECT(sinew_guard_echo(bench->guard, &bench->stamp.echo_ns) == SINEW_OK);
    bench->stamp.counter++;
    seal_as(bench, &data_id);
    return take(bench, wanted);
}

static sinew_output_state state(const struct bench *bench)
{
    sinew_output_state state = -1;
    EXPECT(sinew_guard_state(bench->guard, &state) == SINEW_OK);
    return state;
}

static void come_alive(struct bench *bench)
{
    for (int good = 0; good < 8; good++) {
        EXPECT(sinew_arm(bench->guard) == SINEW_ERROR_NOT_GOOD);
        EXPECT(next(bench, SINEW_NOTHING) == SINEW_FAULT_NONE);
    }
    EXPECT(sinew_arm(bench->guard) == SINEW_OK && state(bench) == SINEW_LIVE);
}

static void begin(struct bench *bench, uint64_t period_ns)
{
    sinew_protected_type type = torque_type(period_ns);
    memset(bench, 0, sizeof *bench);
    bench->stamp.incarnation = 5;
    EXPECT(sinew_guard_alone(&data_id, &type, &bench->motor, make_safe, &bench->guard) == SINEW_OK);
    EXPECT(bench->motor.safe_count == 1 && bench->motor.why == SINEW_SAFE_NOT_ARMED);
    come_alive(bench);
}

/* Safe, made so once, and live again only when it is armed. */
static void is_safe(struct bench *bench, sinew_output_state why)
{
    int torque = 7;
    sinew_output_state since = SINEW_LIVE;
    EXPECT(bench->motor.why == (int)why && bench->motor.safe_count == 2 && bench->motor.torque == 0);
    EXPECT(sinew_apply(bench->guard, move, &torque, &since) == SINEW_NOTHING && since == why);
    EXPECT(bench->motor.torque == 0);
    come_alive(bench);
    EXPECT(sinew_apply(bench->guard, move, &torque, &since) == SINEW_OK && since == SINEW_LIVE);
    EXPECT(bench->motor.torque == 7);
    EXPECT(sinew_release(&bench->guard) == SINEW_OK && bench->guard == NULL);
    EXPECT(bench->motor.torque == 0 && bench->motor.why == SINEW_SAFE_RELEASED);
}

/* No message is late here, however slow the machine is. */
static void begin_patient(struct bench *bench)
{
    begin(bench, 60 * SECOND);
}

static void errors(void)
{
    static struct bench bench;
    sinew_data_id wrong = data_id;
    sinew_tally tally;

    begin_patient(&bench);
    EXPECT(next(&bench, SINEW_OK) == SINEW_FAULT_NONE);
    bench.sealed[SINEW_SEALED_HEAD] ^= 1;
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_CORRUPT && state(&bench) == SINEW_LIVE);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_CORRUPT);
    is_safe(&bench, SINEW_SAFE_TOO_MANY_BAD);

    begin_patient(&bench);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_REPEATED);
    bench.stamp.counter--;
    seal_as(&bench, &data_id);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_BACKWARDS);
    bench.stamp.counter++;
    is_safe(&bench, SINEW_SAFE_TOO_MANY_BAD);

    begin_patient(&bench);
    bench.stamp.counter += 2;
    EXPECT(next(&bench, SINEW_OK) == SINEW_FAULT_NONE);
    bench.stamp.counter += 3;
    EXPECT(next(&bench, SINEW_NOTHING) == SINEW_FAULT_GAP);
    EXPECT(sinew_guard_tally(bench.guard, &tally) == SINEW_OK);
    EXPECT(tally.good == 9 && tally.gaps == 1 && tally.lost == 5 && tally.trips == 1);
    is_safe(&bench, SINEW_SAFE_TOO_MUCH_LOST);

    begin_patient(&bench);
    wrong.destination++;
    bench.stamp.counter++;
    seal_as(&bench, &wrong);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_CORRUPT);
    wrong.destination--;
    wrong.name = SINEW_TEXT("test.speed");
    seal_as(&bench, &wrong);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_CORRUPT);
    bench.stamp.counter--;
    is_safe(&bench, SINEW_SAFE_TOO_MANY_BAD);

    begin_patient(&bench);
    bench.stamp.incarnation++;
    bench.stamp.counter = 0;
    EXPECT(next(&bench, SINEW_NOTHING) == SINEW_FAULT_RESTARTED);
    is_safe(&bench, SINEW_SAFE_RESTARTED);

    begin_patient(&bench);
    bench.stamp.echo_ns = 0;
    bench.stamp.counter++;
    seal_as(&bench, &data_id);
    EXPECT(take(&bench, SINEW_NOTHING) == SINEW_FAULT_TOO_OLD && state(&bench) == SINEW_LIVE);
    EXPECT(sinew_trip(bench.guard) == SINEW_OK && state(&bench) == SINEW_SAFE_TRIPPED);
    is_safe(&bench, SINEW_SAFE_TRIPPED);
}

static void lengths(void)
{
    static struct bench bench;
    uint8_t sealed[3 + SINEW_SEALED_OVERHEAD];
    sinew_sealed_fault fault;
    begin_patient(&bench);
    bench.stamp.counter++;
    EXPECT(sinew_seal(&data_id, &bench.stamp, "abc", 3, sealed, sizeof sealed) == SINEW_OK);
    EXPECT(sinew_check_sealed(bench.guard, sealed, sizeof sealed, &fault) == SINEW_NOTHING);
    EXPECT(fault == SINEW_FAULT_UNREADABLE);
    EXPECT(next(&bench, SINEW_OK) == SINEW_FAULT_NONE);
    EXPECT(sinew_release(&bench.guard) == SINEW_OK);
}

static void silence(void)
{
    static struct bench bench;
    const struct timespec pause = { 0, 1000000 };
    begin(&bench, 500 * MS);
    bench.motor.fails = 3; /* it is tried again until it is done */
    for (int look = 0; look < 30000 && bench.motor.safe_count < 2; look++)
        nanosleep(&pause, NULL);
    is_safe(&bench, SINEW_SAFE_SILENT);
}

/* Fails while the flag is set. */
static int32_t unless(void *output, sinew_output_state why)
{
    const _Atomic int *fails = output;
    (void)why;
    return *fails;
}

static int32_t call_back(void *output, sinew_output_state why)
{
    sinew_guard **guard = output;
    if (why == SINEW_SAFE_NOT_ARMED)
        return 0;
    EXPECT(sinew_arm(*guard) == SINEW_ERROR_BUSY);
    EXPECT(sinew_trip(*guard) == SINEW_OK);
    return 0;
}

static void callbacks(void)
{
    static struct bench bench;
    sinew_protected_type type = torque_type(60 * SECOND);
    sinew_guard *gone;
    EXPECT(sinew_guard_alone(&data_id, &type, &bench.guard, call_back, &bench.guard) == SINEW_OK);
    come_alive(&bench);
    gone = bench.guard;
    EXPECT(sinew_release(&bench.guard) == SINEW_OK && bench.guard == NULL);
    EXPECT(sinew_release(&gone) == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_trip(gone) == SINEW_ERROR_NO_SUCH_GUARD);
}

/* In its own command, where it cannot be released at once. */
static void let_go(void *output, void *argument)
{
    sinew_guard **guard = argument, *gone = *guard;
    (void)output;
    EXPECT(sinew_release(guard) == SINEW_ERROR_BUSY && *guard == gone);
    EXPECT(sinew_release_later(guard) == SINEW_OK && *guard == NULL);
    EXPECT(sinew_trip(gone) == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_release_later(&gone) == SINEW_ERROR_NO_SUCH_GUARD && gone != NULL);
}

/* More guards than there are slots. */
static void ends_in_hand(void)
{
    static struct bench bench;
    for (int ended = 0; ended < 300; ended++) {
        begin_patient(&bench);
        EXPECT(sinew_apply(bench.guard, let_go, &bench.guard, NULL) == SINEW_OK && bench.guard == NULL);
        EXPECT(bench.motor.safe_count == 2 && bench.motor.why == SINEW_SAFE_TRIPPED);
    }
}

/* An output that is not known to be safe is not reported as safe, and the library completes its release. */
static void failures(void)
{
    static _Atomic int fails = 1;
    const struct timespec pause = { 0, 1000000 };
    sinew_protected_type type = torque_type(60 * SECOND);
    sinew_output_state state = SINEW_LIVE;
    sinew_guard *guard = NULL;
    sinew_status status = SINEW_ERROR_SAFE_FAILS;
    int torque = 7;
    EXPECT(sinew_guard_alone(&data_id, &type, &fails, unless, &guard) == SINEW_ERROR_SAFE_FAILS && guard != NULL);
    EXPECT(sinew_guard_state(guard, &state) == SINEW_ERROR_SAFE_FAILS && state == SINEW_SAFE_NOT_ARMED);
    state = SINEW_LIVE;
    EXPECT(sinew_apply(guard, move, &torque, &state) == SINEW_ERROR_SAFE_FAILS && state == SINEW_SAFE_NOT_ARMED);
    EXPECT(sinew_arm(guard) == SINEW_ERROR_SAFE_FAILS);
    EXPECT(sinew_release(&guard) == SINEW_ERROR_SAFE_FAILS && guard != NULL);
    EXPECT(sinew_guard_state(guard, &state) == SINEW_ERROR_SAFE_FAILS);
    fails = 0;
    for (int look = 0; look < 30000 && status != SINEW_ERROR_NO_SUCH_GUARD; look++) {
        nanosleep(&pause, NULL);
        status = sinew_guard_state(guard, &state);
        /* The output can be safe for a moment before its guard is released. */
        EXPECT(status == SINEW_ERROR_SAFE_FAILS || status == SINEW_ERROR_NO_SUCH_GUARD || status == SINEW_OK);
    }
    EXPECT(status == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_release(&guard) == SINEW_ERROR_NO_SUCH_GUARD);
}

/* An endpoint that is unregistered, or called, by a thread that uses an output. */
struct walk {
    sinew_endpoint *control, *drive;
    sinew_guard *guard;
    struct motor motor;
    sinew_status receives;
};

static void receive_in_hand(void *output, void *argument)
{
    struct walk *walk = argument;
    sinew_received received;
    (void)output;
    walk->receives = sinew_receive_message(walk->drive, 0, &received);
}

/* Two endpoints of one node, and an output that is live. */
static void begin_walk(struct walk *walk, const char *socket)
{
    const sinew_options options = { .size = sizeof options };
    const struct torque torque = { 2.5f, 0 };
    sinew_protected_type type = torque_type(60 * SECOND);
    sinew_status status = SINEW_ERROR_NOT_GOOD;
    sinew_received received;
    sinew_tid to;
    memset(walk, 0, sizeof *walk);
    EXPECT(sinew_register_transport_address(sinew_text_of(socket), &options, &walk->control) == SINEW_OK);
    EXPECT(sinew_register_transport_address(sinew_text_of(socket), &options, &walk->drive) == SINEW_OK);
    to = sinew_endpoint_tid(walk->drive);
    EXPECT(sinew_guard_output(walk->drive, sinew_endpoint_tid(walk->control), &type, &walk->motor, make_safe,
                              &walk->guard) == SINEW_OK);
    for (int look = 0; look < 3000 && status != SINEW_OK; look++) {
        EXPECT(sinew_send_protected(walk->control, to, &type, &torque, sizeof torque) == SINEW_OK);
        EXPECT(sinew_receive_message(walk->drive, 10 * MS, &received) == SINEW_NOTHING);
        /* The first echo may be sent before the first protected message; it is ignored. Echoes are two minutes apart. */
        while (sinew_receive_message(walk->control, 0, &received) == SINEW_OK)
            EXPECT(sinew_settle_message(walk->control, &received, SINEW_DELIVERED) == SINEW_OK);
        status = sinew_arm(walk->guard);
    }
    EXPECT(status == SINEW_OK);
}

static void endpoints(const char *socket)
{
    static struct walk walk;
    sinew_output_state state = SINEW_LIVE;
    begin_walk(&walk, socket);
    EXPECT(sinew_apply(walk.guard, receive_in_hand, &walk, &state) == SINEW_OK);
    EXPECT(walk.receives == SINEW_ERROR_BUSY);
    EXPECT(sinew_guard_state(walk.guard, &state) == SINEW_OK && state == SINEW_LIVE);
    walk.motor.torque = 7;
    EXPECT(sinew_unregister(&walk.drive) == SINEW_OK);
    /* First: if the library's thread was faster, this waits for it. */
    EXPECT(sinew_guard_state(walk.guard, &state) == SINEW_OK && state == SINEW_SAFE_TRIPPED);
    EXPECT(walk.motor.torque == 0 && walk.motor.why == SINEW_SAFE_TRIPPED);
    EXPECT(sinew_release(&walk.guard) == SINEW_OK);
    EXPECT(sinew_unregister(&walk.control) == SINEW_OK);
}

static void misuse(void)
{
    sinew_protected_type type = torque_type(60 * SECOND), bad = type;
    sinew_guard *guard = NULL;
    sinew_stamp stamp = { 1, 2, 3 }, found;
    uint8_t sealed[SINEW_SEALED_OVERHEAD];
    EXPECT(sinew_guard_alone(NULL, &type, NULL, make_safe, &guard) == SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(sinew_guard_alone(&data_id, NULL, NULL, make_safe, &guard) == SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(sinew_guard_alone(&data_id, &type, NULL, NULL, &guard) == SINEW_ERROR_INVALID_ARGUMENT);
    bad.within_ns = 0;
    EXPECT(sinew_guard_alone(&data_id, &bad, NULL, make_safe, &guard) == SINEW_ERROR_INVALID_ARGUMENT);
    bad = type;
    bad.good_min = 0;
    EXPECT(sinew_guard_alone(&data_id, &bad, NULL, make_safe, &guard) == SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(sinew_guard_output(NULL, 1, &type, NULL, make_safe, &guard) == SINEW_ERROR_NO_SUCH_ENDPOINT);
    EXPECT(sinew_send_protected(NULL, 1, &type, NULL, 0) == SINEW_ERROR_NO_SUCH_ENDPOINT);
    EXPECT(sinew_seal(&data_id, &stamp, NULL, 0, sealed, sizeof sealed - 1) == SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(sinew_seal(&data_id, &stamp, NULL, 0, sealed, sizeof sealed) == SINEW_OK);
    EXPECT(sinew_unseal(&data_id, sealed, sizeof sealed, &found) == SINEW_OK);
    EXPECT(found.counter == 1 && found.incarnation == 2 && found.echo_ns == 3);
    EXPECT(sinew_unseal(&data_id, sealed, sizeof sealed - 1, &found) == SINEW_ERROR_MALFORMED);
    EXPECT(sinew_arm(NULL) == SINEW_ERROR_NO_SUCH_GUARD && sinew_trip(NULL) == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_release_later(NULL) == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_release_later(&guard) == SINEW_ERROR_NO_SUCH_GUARD);
    EXPECT(sinew_guard_state(NULL, NULL) == SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(strcmp(sinew_output_state_text(99), "no state of an output") == 0);
}

/* As many guards as possible: a slot is reused after a release, a handle is not. */
static void many(void)
{
    static sinew_guard *guards[256];
    static struct motor motor;
    sinew_protected_type type = torque_type(60 * SECOND);
    sinew_guard *more, *gone;
    for (size_t at = 0; at < 256; at++)
        EXPECT(sinew_guard_alone(&data_id, &type, &motor, make_safe, &guards[at]) == SINEW_OK);
    EXPECT(sinew_guard_alone(&data_id, &type, &motor, make_safe, &more) == SINEW_ERROR_TOO_MANY);
    gone = guards[100];
    EXPECT(sinew_release(&guards[100]) == SINEW_OK);
    EXPECT(sinew_guard_alone(&data_id, &type, &motor, make_safe, &guards[100]) == SINEW_OK);
    EXPECT(guards[100] != gone && sinew_arm(gone) == SINEW_ERROR_NO_SUCH_GUARD);
    for (size_t at = 0; at < 256; at++)
        EXPECT(sinew_release(&guards[at]) == SINEW_OK);
}

/* The child does not have its parent's threads. */
static void in_a_child(void)
{
    static struct bench bench;
    sinew_protected_type type = torque_type(60 * SECOND);
    sinew_guard *own;
    int status;
    pid_t child;
    begin_patient(&bench);
    child = fork();
    EXPECT(child >= 0);
    if (child == 0) {
        bool is_refused = sinew_trip(bench.guard) == SINEW_ERROR_FORKED
            && sinew_arm(bench.guard) == SINEW_ERROR_FORKED
            && sinew_guard_alone(&data_id, &type, &bench.motor, make_safe, &own) == SINEW_ERROR_FORKED;
        _exit(is_refused ? EXIT_SUCCESS : EXIT_FAILURE);
    }
    EXPECT(waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS);
    EXPECT(state(&bench) == SINEW_LIVE && sinew_release(&bench.guard) == SINEW_OK);
}

int main(int argc, char **argv)
{
    errors();
    lengths();
    silence();
    callbacks();
    ends_in_hand();
    failures();
    if (argc > 1)
        endpoints(argv[1]);
    misuse();
    many();
    in_a_child();
    puts("all well");
    return EXIT_SUCCESS;
}

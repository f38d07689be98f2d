/* Commands that move something, protected end to end. A control sends torques, and a drive follows them while they are good:
 *
 *   commands SOCKET control COUNT     sends one each 20 ms
 *   commands SOCKET drive             ends when its output has become safe again
 *
  * Either may be a program in Rust with  struct Torque { newton_metres: f32 }  of that NAME, and Protection::of_period(500 ms).
 */
#define _POSIX_C_SOURCE 200809L

#include <sinew.h>

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define MS UINT64_C(1000000)
#define SECOND UINT64_C(1000000000)

/* The command: a map of one field, five bytes and the field's name long. */
struct torque { float newton_metres; };
static const sinew_field torque_fields[] = { SINEW_FIELD(struct torque, newton_metres) };
static const sinew_payload_type torque_payload = SINEW_PAYLOAD("demo.commanded_torque", SINEW_STREAM, struct torque, torque_fields);
#define TORQUE_LENGTH (1 + 1 + sizeof "newton_metres" - 1 + 5)

/* Whether a call has failed; prints the error if so. */
static bool is_error(sinew_status status)
{
    if (status >= 0)
        return false;
    fprintf(stderr, "commands: %s\n", sinew_last_error());
    return true;
}

/* Do not use while an output may be live: the end of the process makes none safe. */
static sinew_status check(sinew_status status)
{
    if (is_error(status))
        exit(EXIT_FAILURE);
    return status;
}

/* Both ends declare the same type. The output is safe 1.5 s after the last good command; a machine has shorter periods. */
static sinew_protected_type torque_type(void)
{
    return sinew_protected_type_of(SINEW_TEXT("demo.commanded_torque"), TORQUE_LENGTH, 500 * MS);
}

static sinew_tid await_name(sinew_endpoint *endpoint, sinew_text name)
{
    sinew_tid tid = 0;
    for (int look = 0; look < 600; look++) {
        const struct timespec pause = { 0, 50000000 };
        if (check(sinew_resolve(endpoint, name, 10 * SECOND, &tid)) == SINEW_OK)
            return tid;
        nanosleep(&pause, NULL);
    }
    fprintf(stderr, "commands: the other one did not come within 30 s\n");
    exit(EXIT_FAILURE);
}

static int control(sinew_endpoint *endpoint, long count)
{
    const sinew_protected_type type = torque_type();
    const sinew_tid drive = await_name(endpoint, SINEW_TEXT("knee.drive"));
    const struct torque torque = { 2.5f };
    unsigned char bytes[TORQUE_LENGTH];
    sinew_received received;
    size_t length;
    check(sinew_encode_value(&torque_payload, &torque, bytes, sizeof bytes, &length));
    for (long sent = 0; sent < count; sent++) {
        check(sinew_send_protected(endpoint, drive, &type, bytes, length));
        /* The drive's echoes, which the library quotes, arrive here; this program ignores them. */
        if (check(sinew_receive_message(endpoint, 20 * MS, &received)) == SINEW_OK)
            check(sinew_settle_message(endpoint, &received, SINEW_DELIVERED));
    }
    return EXIT_SUCCESS;
}

/* The output of a drive; a number here. */
struct motor { float newton_metres; };

/* Called by a thread of the library, too: keep it short, and do not wait. */
static int32_t make_safe(void *output, sinew_output_state why)
{
    (void)why;
    ((struct motor *)output)->newton_metres = 0.0f;
    return 0;
}

static void move(void *output, void *argument)
{
    ((struct motor *)output)->newton_metres = *(const float *)argument;
}

static sinew_status follow(sinew_guard *guard, const sinew_received *command)
{
    sinew_status status;
    struct torque torque;
    /* The seal is valid, but we cannot read the payload: the guard checks only its length, and counts it as good. */
    if (is_error(sinew_decode_value(&torque_payload, command->bytes, command->length, &torque)))
        return sinew_trip(guard);
    status = sinew_apply(guard, move, &torque.newton_metres, NULL);
    if (status == SINEW_OK) {
        printf("moved by %.1f Nm\n", (double)torque.newton_metres);
        fflush(stdout);
    }
    return status;
}

/* Follows commands until the output has become safe; false after an error, when it may be live. */
static bool follow_all(sinew_endpoint *endpoint, sinew_guard *guard, sinew_kind torque)
{
    sinew_output_state state = SINEW_SAFE_NOT_ARMED;
    sinew_received received;
    bool is_armed = false;
    while (!is_armed || state == SINEW_LIVE) {
        sinew_status status;
        /* Here a person has checked that it is safe; rejected until enough good commands have arrived. Never automatic. */
        if (!is_armed)
            is_armed = sinew_arm(guard) == SINEW_OK;
        status = sinew_receive_message(endpoint, 20 * MS, &received);
        if (is_error(status))
            return false;
        if (status == SINEW_OK) {
            if (received.kind == torque && is_error(follow(guard, &received)))
                return false;
            if (is_error(sinew_settle_message(endpoint, &received, SINEW_DELIVERED)))
                return false;
        }
        if (is_error(sinew_guard_state(guard, &state)))
            return false;
    }
    printf("%s\n", sinew_output_state_text(state));
    return true;
}

static int drive(sinew_endpoint *endpoint)
{
    static struct motor motor;
    const struct timespec pause = { 0, 1000000 };
    const sinew_protected_type type = torque_type();
    const sinew_tid source = await_name(endpoint, SINEW_TEXT("knee.control"));
    sinew_guard *guard;
    bool is_well;
    check(sinew_guard_output(endpoint, source, &type, &motor, make_safe, &guard));
    is_well = follow_all(endpoint, guard, sinew_kind_named(type.name));
    /* Before the program ends, after success or failure. If it cannot be made safe the library retries while this process runs. */
    while (sinew_release(&guard) == SINEW_ERROR_SAFE_FAILS)
        nanosleep(&pause, NULL);
    return is_well ? EXIT_SUCCESS : EXIT_FAILURE;
}

int main(int argc, char **argv)
{
    const bool is_drive = argc == 3 && strcmp(argv[2], "drive") == 0;
    const bool is_control = argc == 4 && strcmp(argv[2], "control") == 0;
    sinew_options options = { .size = sizeof options };
    sinew_endpoint *endpoint;
    int result;
    if (!is_drive && !is_control) {
        fprintf(stderr, "usage: commands SOCKET control COUNT, or commands SOCKET drive\n");
        return EXIT_FAILURE;
    }
    options.name = sinew_text_of(is_drive ? "knee.drive" : "knee.control");
    check(sinew_register_transport_address(sinew_text_of(argv[1]), &options, &endpoint));
    result = is_drive ? drive(endpoint) : control(endpoint, strtol(argv[3], NULL, 10));
    check(sinew_unregister(&endpoint));
    return result;
}

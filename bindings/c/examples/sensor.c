/* The knee's sensor: waits until the drive is ready, sends it an angle each millisecond, then requests its report.
 *
 *   sensor SOCKET [ANGLES]
 */
#define _POSIX_C_SOURCE 200809L

#include <sinew.h>

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define SECOND UINT64_C(1000000000)

/* The payload types: a struct, the table of its fields, and the name and class of the type. */
struct joint_angle { float degrees; uint32_t number; };
static const sinew_field angle_fields[] = { SINEW_FIELD(struct joint_angle, degrees), SINEW_FIELD(struct joint_angle, number) };
static const sinew_payload_type angle_type = SINEW_PAYLOAD("demo.joint_angle", SINEW_STREAM, struct joint_angle, angle_fields);

struct drive_report { float degrees; uint32_t number; };
static const sinew_field report_fields[] = { SINEW_FIELD(struct drive_report, degrees), SINEW_FIELD(struct drive_report, number) };
static const sinew_payload_type report_type = SINEW_PAYLOAD("demo.drive_report", SINEW_CONTROL, struct drive_report, report_fields);

/* A program that controls something does not continue after an error. */
static void check(sinew_status status, const char *what)
{
    if (status < 0) {
        fprintf(stderr, "%s: %s\n", what, sinew_last_error());
        exit(EXIT_FAILURE);
    }
}

static void send_angle(sinew_endpoint *sensor, sinew_tid drive, uint32_t number)
{
    struct joint_angle angle = { 30.0f * sinf((float)number / 100.0f), number };
    sinew_message message;
    /* Written into the memory that the drive's side reads: sending copies nothing. */
    check(sinew_create_value(sensor, drive, &angle_type, &angle, &message), "create");
    check(sinew_send_message(sensor, &message), "send");
}

static struct drive_report ask_report(sinew_endpoint *sensor, sinew_tid drive)
{
    struct drive_report report;
    sinew_message request;
    sinew_received reply;
    sinew_kind kind = sinew_kind_named(SINEW_TEXT("demo.drive_report"));
    check(sinew_create_message(sensor, drive, kind, SINEW_CONTROL, 0, &request), "create");
    check(sinew_ask(sensor, &request, 10 * SECOND, &reply, NULL), "ask");
    check(sinew_read_value(&reply, &report_type, &report), "read the report");
    check(sinew_settle_message(sensor, &reply, SINEW_DELIVERED), "settle");
    return report;
}

/* Of a stream only the newest value counts, so the last one is sent again in class Control, which can be confirmed. */
static void send_last(sinew_endpoint *sensor, sinew_tid drive, uint32_t number)
{
    struct joint_angle angle = { 0.0f, number };
    sinew_message message;
    sinew_outcome outcome;
    sinew_payload_type confirmed = angle_type;
    confirmed.message_class = SINEW_CONTROL;
    check(sinew_create_value(sensor, drive, &confirmed, &angle, &message), "create");
    check(sinew_send_message_confirmed(sensor, &message, 10 * SECOND, &outcome), "send confirmed");
    printf("last angle: %s\n", sinew_outcome_text(outcome));
}

int main(int argc, char **argv)
{
    sinew_endpoint *sensor;
    sinew_tid drive;
    sinew_text drive_name = SINEW_TEXT("knee.drive");
    sinew_options options = { .size = sizeof options, .name = SINEW_TEXT("knee.sensor"),
                              .required = &drive_name, .required_count = 1, .deadline_ns = 10 * SECOND };
    uint32_t angles = argc > 2 ? (uint32_t)strtoul(argv[2], NULL, 10) : 1000;
    struct timespec next;
    struct drive_report report;

    if (argc < 2) {
        fprintf(stderr, "usage: sensor SOCKET [ANGLES]\n");
        return EXIT_FAILURE;
    }
    check(sinew_register_transport_address(sinew_text_of(argv[1]), &options, &sensor), "register");
    check(sinew_resolve(sensor, drive_name, 10 * SECOND, &drive), "resolve");
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (uint32_t number = 1; number < angles; number++) {
        send_angle(sensor, drive, number);
        next.tv_nsec += 1000000;
        if (next.tv_nsec >= (long)SECOND) {
            next.tv_nsec -= (long)SECOND;
            next.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
    }
    send_last(sensor, drive, angles);
    report = ask_report(sensor, drive);
    printf("the drive of node %s is at number %" PRIu32 "\n", sinew_node_name(sensor), report.number);
    check(sinew_unregister(&sensor), "unregister");
    return EXIT_SUCCESS;
}

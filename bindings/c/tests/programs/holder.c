/* Never settles messages of kind test.held, and doubles torques. */
#include "fail.h"

#define MAX_HELD 8

struct torque { float newton_metres; };
static const sinew_field torque_fields[] = { SINEW_FIELD(struct torque, newton_metres) };
static const sinew_payload_type torque_type = SINEW_PAYLOAD("test.torque", SINEW_CONTROL, struct torque, torque_fields);

static sinew_status reply_doubled(sinew_endpoint *holder, const sinew_received *request, struct torque torque)
{
    sinew_message reply;
    sinew_status status;
    torque.newton_metres *= 2.0f;
    status = sinew_create_value(holder, request->source, &torque_type, &torque, &reply);
    return status < 0 ? status : sinew_reply(holder, request, &reply);
}

int main(int argc, char **argv)
{
    sinew_endpoint *holder;
    sinew_received held[MAX_HELD];
    size_t count = 0;
    sinew_options options = { .size = sizeof options, .name = SINEW_TEXT("holder") };
    struct torque torque;
    sinew_status status = sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : NULL), &options, &holder);
    if (status < 0)
        return fail("register", status);
    printf("ready\n");
    fflush(stdout);
    while (count < MAX_HELD) {
        status = sinew_receive_message(holder, UINT64_MAX, &held[count]);
        if (status == SINEW_ERROR_DISCONNECTED) {
            printf("away: %s\n", sinew_last_error());
            fflush(stdout);
            continue;
        }
        if (status != SINEW_OK)
            return fail("receive", status);
        status = sinew_read_value(&held[count], &torque_type, &torque);
        if (status < 0)
            return fail("read", status);
        if (status == SINEW_OK) {
            status = reply_doubled(holder, &held[count], torque);
            if (status < 0)
                return fail("reply", status);
            sinew_settle_message(holder, &held[count], SINEW_DELIVERED);
        } else {
            printf("held %zu bytes\n", held[count].length);
            fflush(stdout);
            count++;
        }
    }
    return 0;
}

/* Takes commands without fields, each with a reply of the same type. In C99, C11 and C++. */
#include "fail.h"

static const sinew_payload_type stop_type = SINEW_PAYLOAD_EMPTY("test.stop", SINEW_CONTROL);
static const sinew_payload_type brief_type = SINEW_PAYLOAD_EMPTY_EXPIRING("test.brief_stop", SINEW_CONTROL, UINT64_C(60000000000));

/* The command comes back to its sender, once as a reply and once as a message that expires. */
static sinew_status send_back(sinew_endpoint *stopping, const sinew_received *request)
{
    sinew_message message;
    sinew_status status = sinew_create_value(stopping, request->source, &stop_type, NULL, &message);
    if (status < 0)
        return status;
    status = sinew_reply(stopping, request, &message);
    if (status < 0)
        return status;
    status = sinew_create_value(stopping, request->source, &brief_type, NULL, &message);
    return status < 0 ? status : sinew_send_message(stopping, &message);
}

int main(int argc, char **argv)
{
    sinew_endpoint *stopping;
    sinew_options options;
    sinew_received received;
    sinew_status status;
    memset(&options, 0, sizeof options);
    options.size = sizeof options;
    options.name = sinew_text_of("stopping");
    status = sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : NULL), &options, &stopping);
    if (status < 0)
        return fail("register", status);
    printf("ready\n");
    fflush(stdout);
    for (;;) {
        status = sinew_receive_message(stopping, UINT64_MAX, &received);
        if (status != SINEW_OK)
            return fail("receive", status);
        status = sinew_read_value(&received, &stop_type, NULL);
        if (status < 0) {
            printf("refused: %s\n", sinew_last_error());
            fflush(stdout);
            sinew_settle_message(stopping, &received, SINEW_REJECTED_MALFORMED);
            continue;
        }
        if (status == SINEW_NOTHING)
            break;
        status = send_back(stopping, &received);
        if (status < 0)
            return fail("send back", status);
        sinew_settle_message(stopping, &received, SINEW_DELIVERED);
    }
    return sinew_unregister(&stopping) == SINEW_OK ? 0 : 1;
}

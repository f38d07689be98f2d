/* Sends to itself through a node that is stopped: the status without room, and that no message is lost. */
#include "expect.h"

/* The test gives the signal to continue. */
static void await_word(const char *before)
{
    char line[16];
    printf("%s\n", before);
    fflush(stdout);
    EXPECT(fgets(line, sizeof line, stdin) != NULL);
}

static sinew_status send_number(sinew_endpoint *endpoint, sinew_kind kind, uint32_t number, uint64_t within_ns)
{
    sinew_message message;
    sinew_status status;
    EXPECT(sinew_create_message(endpoint, sinew_endpoint_tid(endpoint), kind, SINEW_BULK, 1000, &message) == SINEW_OK);
    memcpy(message.bytes, &number, sizeof number);
    EXPECT(sinew_room_within(endpoint, &message, within_ns) == SINEW_OK);
    status = sinew_send_message(endpoint, &message);
    EXPECT(message.token == 0);
    return status;
}

int main(int argc, char **argv)
{
    sinew_endpoint *endpoint = NULL;
    sinew_options options = { .size = sizeof options };
    sinew_kind kind = sinew_kind_named(SINEW_TEXT("test.room"));
    uint32_t sent = 0, number;
    uint64_t began;
    sinew_status status;
    sinew_received received;
    EXPECT(argc > 2);
    options.links = strcmp(argv[2], "socket") == 0 ? SINEW_SOCKET_ONLY : 0;
    options.stall_timeout_ns = 60 * SECOND;
    EXPECT(sinew_register_transport_address(sinew_text_of(argv[1]), &options, &endpoint) == SINEW_OK);
    await_word("stop it");
    while ((status = send_number(endpoint, kind, sent, 0)) == SINEW_OK)
        sent++;
    EXPECT(sent > 0 && status == SINEW_ERROR_STALLED && strstr(sinew_last_error(), "no room") != NULL);
    /* A message without room does not arrive; a send with a time limit waits that long. */
    EXPECT(send_number(endpoint, kind, 1000000, 0) == SINEW_ERROR_STALLED);
    began = sinew_now_ns();
    EXPECT(send_number(endpoint, kind, 1000000, SECOND / 50) == SINEW_ERROR_STALLED);
    EXPECT(sinew_now_ns() - began >= SECOND / 50);
    await_word("let it go on");
    EXPECT(send_number(endpoint, kind, sent, 60 * SECOND) == SINEW_OK);
    for (uint32_t expected = 0; expected <= sent; ) {
        EXPECT(sinew_receive_message(endpoint, 60 * SECOND, &received) == SINEW_OK);
        if (received.length == 1000) {
            memcpy(&number, received.bytes, sizeof number);
            EXPECT(number == expected);
            expected++;
        }
        EXPECT(sinew_settle_message(endpoint, &received, SINEW_DELIVERED) == SINEW_OK);
    }
    EXPECT(sinew_unregister(&endpoint) == SINEW_OK);
    printf("all came\n");
    return EXIT_SUCCESS;
}

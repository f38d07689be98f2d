/* Presses the stop of the whole system, releases it by a message, and acknowledges it. */
#include "expect.h"

struct release {
    uint32_t within_ms;
};

static const sinew_field release_fields[] = { { "within_ms", 0, sizeof(uint32_t), 0, NULL, SINEW_TYPE_U32, 0 } };
static const sinew_payload_type release_type = SINEW_PAYLOAD("sinew.stop.release", SINEW_CONTROL, struct release, release_fields);

/* The release is a request to the stop of the own node. */
static void release(sinew_endpoint *button, sinew_tid stop)
{
    struct release order = { 10000 };
    sinew_message message;
    sinew_received reply;
    sinew_outcome outcome;
    EXPECT(sinew_create_value(button, stop, &release_type, &order, &message) == SINEW_OK);
    EXPECT(sinew_ask(button, &message, 20 * SECOND, &reply, &outcome) == SINEW_OK);
    EXPECT(sinew_settle_message(button, &reply, SINEW_DELIVERED) == SINEW_OK);
}

int main(int argc, char **argv)
{
    sinew_endpoint *button = NULL;
    sinew_stop_node nodes[4];
    sinew_stop_report report;
    sinew_text broken;
    broken.bytes = NULL;
    broken.length = 7;
    EXPECT(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : NULL), NULL, &button) == SINEW_OK);
    EXPECT(sinew_ask_stop(button, 20 * SECOND, nodes, 4, &report) == SINEW_OK);
    EXPECT(report.state != SINEW_STOP_STOPPED && report.presses == 0 && !report.is_confirmed);

    /* A node that has just started confirms after its hold. */
    EXPECT(sinew_press_stop(button, sinew_text_of("a test"), 20 * SECOND, nodes, 4, &report) == SINEW_OK);
    EXPECT(report.is_confirmed && report.state == SINEW_STOP_STOPPED && report.nodes == 1 && report.presses == 1);
    EXPECT(strcmp(nodes[0].name, "knee") == 0 && nodes[0].state == SINEW_STOP_STOPPED);
    EXPECT(nodes[0].confirmed_ns < 20 * SECOND);
    EXPECT(sinew_acknowledge_stop(button, 20 * SECOND) == SINEW_ERROR_NOT_HANDLED);

    /* Wrong arguments hinder no press. */
    EXPECT(sinew_press_stop(button, broken, 0, NULL, 4, NULL) == SINEW_OK);
    EXPECT(sinew_press_stop(NULL, sinew_text_of("a test"), 0, nodes, 4, &report) == SINEW_ERROR_NO_SUCH_ENDPOINT);

    release(button, nodes[0].tid);
    EXPECT(sinew_ask_stop(button, 20 * SECOND, NULL, 0, &report) == SINEW_OK);
    EXPECT(report.state == SINEW_STOP_RELEASED && report.presses == 0 && report.nodes == 1);
    EXPECT(sinew_acknowledge_stop(button, 20 * SECOND) == SINEW_OK);
    EXPECT(sinew_unregister(&button) == SINEW_OK);
    printf("pressed and released\n");
    return 0;
}

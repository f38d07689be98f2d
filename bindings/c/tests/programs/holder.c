/* Holds what it gets of kind test.held for ever, and doubles torques: {"newton_metres": float32} in MessagePack. */
#include <sinew.h>

#include <stdio.h>

#define MAX_HELD 8

/* A map of one field (0x81), its name (0xa0 + length), a float32 (0xca): then four bytes, the most significant first. */
static const unsigned char torque_head[] = "\x81\xadnewton_metres\xca";
#define HEAD (sizeof torque_head - 1)

static float torque_of(const unsigned char *bytes)
{
    uint32_t bits = (uint32_t)bytes[0] << 24 | (uint32_t)bytes[1] << 16 | (uint32_t)bytes[2] << 8 | bytes[3];
    float torque;
    memcpy(&torque, &bits, sizeof torque);
    return torque;
}

static void put_torque(unsigned char *bytes, float torque)
{
    uint32_t bits;
    memcpy(&bits, &torque, sizeof bits);
    for (int byte = 0; byte < 4; byte++)
        bytes[byte] = (unsigned char)(bits >> (24 - 8 * byte));
}

static int fail(const char *what, sinew_status status)
{
    printf("%s: %d: %s\n", what, (int)status, sinew_last_error());
    return 1;
}

static sinew_status reply_doubled(sinew_endpoint *holder, const sinew_received *request)
{
    sinew_message reply;
    sinew_status status;
    if (request->length != HEAD + 4 || memcmp(request->bytes, torque_head, HEAD) != 0)
        return SINEW_ERROR_MALFORMED;
    status = sinew_create_message(holder, request->source, request->kind, SINEW_CONTROL, HEAD + 4, &reply);
    if (status < 0)
        return status;
    memcpy(reply.bytes, torque_head, HEAD);
    put_torque(reply.bytes + HEAD, 2.0f * torque_of(request->bytes + HEAD));
    return sinew_reply(holder, request, &reply);
}

int main(int argc, char **argv)
{
    sinew_endpoint *holder;
    sinew_received held[MAX_HELD];
    size_t count = 0;
    sinew_options options = { .size = sizeof options, .name = SINEW_TEXT("holder") };
    sinew_kind torque = sinew_kind_named(SINEW_TEXT("test.torque"));
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
        if (held[count].kind == torque) {
            status = reply_doubled(holder, &held[count]);
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

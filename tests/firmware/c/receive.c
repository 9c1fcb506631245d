/* libFuzzer: any bytes on the line, and any payloads in good datagrams, leave the board sound.

   The first byte chooses: raw bytes, or a sequence of (type, length, payload) sent as good datagrams. */
#include "board.c"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void drain(struct native *board)
{
    board_run_us(board, 1000u);
    board->bench.output_length = 0u;
    board->bench.record_count = 0u;
}

static void send_datagram(struct native *board, uint16_t sequence, uint16_t session, uint8_t type,
                          const uint8_t *payload, uint32_t length)
{
    static struct evlcp_link link;
    const struct evlcp_datagram d = {
        .type = type, .sequence = sequence, .session = session, .payload = payload, .length = length};
    evlcp_link_put(&link, &d);
    board_input(board, link.wire, link.wire_length);
    drain(board);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const uint8_t id[12];
    if (size == 0u)
        return 0;
    struct native *board = board_new(id);
    const uint8_t hello[sizeof(struct evlcp_hello_request)] = {EVLCP_PROTOCOL_MAJOR, EVLCP_PROTOCOL_MINOR, 1u};
    send_datagram(board, 0u, EVLCP_NO_SESSION, EVLCP_TYPE_HELLO, hello, sizeof hello);
    if ((data[0] & 1u) == 0u) {
        for (size_t at = 1; at < size; at += 512u) {
            board_input(board, data + at, size - at < 512u ? size - at : 512u);
            drain(board);
        }
        board_free(board);
        return 0;
    }
    uint16_t sequence = 1u;
    size_t at = 1u;
    while (at + 2u <= size) {
        uint8_t type = data[at];
        size_t length = 2u * data[at + 1u];
        at += 2u;
        if (length > size - at)
            length = size - at;
        send_datagram(board, sequence++, board->core.session, type, data + at, (uint32_t)length);
        at += length;
    }
    for (uint32_t i = 0; i < 400u; i++)
        drain(board);
    board_free(board);
    return 0;
}

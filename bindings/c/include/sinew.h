#ifndef SINEW_H
#define SINEW_H

/*
 * Sinew: NodeAPI for C and C++. Written from the source of bindings/c; do not edit.
 *
 * An application connects to the node of its host, gets a transport address (an endpoint), and sends and receives
 * messages on it. bindings/c/README.md has a first program; docs/SEMANTICS.md says what is promised of messages.
 *
 * Threads.  An endpoint is one thread's at a time: a call on it while another thread is in one returns
 *   SINEW_ERROR_BUSY and does nothing. Different endpoints are independent: take one for each thread. Each function says
 *   who may call it. "The endpoint's thread": whichever thread has it now; to hand it on, order the last call of the one
 *   before the first of the other (a mutex, a queue, pthread_join). "Any thread": any number, at any time. The sentence of
 *   sinew_last_error is the thread's own.
 * Messages.  A message that is handed to a function that sends is gone when it returns, whatever that returns, and
 *   `*message` is all zeros. Four errors are said before a message is looked at, which is left as it was then:
 *   SINEW_ERROR_BUSY (it is still yours), and SINEW_ERROR_NO_SUCH_ENDPOINT, _FORKED and _PANIC (nobody can send it; it
 *   goes with its endpoint). SINEW_ERROR_NO_SUCH_MESSAGE: it was gone before. A received message is in hand until
 *   sinew_settle_message returns SINEW_OK, or its endpoint is unregistered.
 * Pointers.  NULL is refused where it is not said to be legal. Any other pointer must point to what its type says, for
 *   the length of the call. Endpoints and messages are looked up, not followed: one that was unregistered, sent,
 *   discarded or settled is refused. The `bytes` of a message are good until then, and not after. Between two calls any
 *   one thread may write or read them.
 * Out.  What is given back through a pointer is set if the function returns SINEW_OK, and else left as it was, unless
 *   the function says more.
 * Time.  All times are nanoseconds, as their names say; UINT64_MAX waits for ever.
 * Texts.  UTF-8 with a length. Texts that the library hands out end with a zero and are not to be freed.
 * Panics.  A fault of the library ends as SINEW_ERROR_PANIC and never leaves it. The endpoint on which it happened can
 *   only be unregistered; everything else goes on.
 * fork.  A child of fork may not use its parent's endpoints: they return SINEW_ERROR_FORKED there; nor may it write the
 *   bytes of its parent's messages, which may be shared memory. It may register its
 *   own if it may call malloc, that is if the parent had one thread. The node sees the parent's end also while a child
 *   lives that has its connections, too, and tells the peers of its direct links.
 *   Endpoints do not survive exec.
 * Protected.  Commands that move something: sinew_send_protected seals them, and sinew_guard_output lets only good ones through to an
 *   output, which is made safe when they are not, or do not come; sinew_arm makes it live, and nothing else does. The same bytes and
 *   rules as in Rust (docs/protocol/protected.md). The functions that a guard calls may call nothing of a guard but sinew_trip and
 *   sinew_release_later, and no sinew_receive_message of an endpoint with protected payloads (SINEW_ERROR_BUSY). A guard knows a payload's length, and not whether you can
 *   read it: who cannot calls sinew_trip. An output is not called safe while what makes it safe fails (SINEW_ERROR_SAFE_FAILS). Release guards before their outputs, and before the end of main. A child of fork has no guards of its parent's, and
 *   none of its own where the parent had some, or tried to make one (SINEW_ERROR_FORKED): its outputs are not made safe there.
 * Log.  What no status tells (a link that was not made, no shared memory) is a line on the standard error, warnings and
 *   errors only. The environment variable SINEW_LOG says otherwise: off, error, warn, info, debug; it is read at the first
 *   registration or guard.
 * Sizes.  sinew_options carries its size and may grow; all other structs and all numbers stay as they are as long as
 *   SINEW_ABI does.
 */


#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/**
 * The version of this header's structs and functions. It grows when a program must be compiled anew.
 */
#define SINEW_ABI 1

/**
 * Bytes that any TID's text needs, its zero included: `255.255.255.255/ffffffff`.
 */
#define SINEW_TID_TEXT 32

/**
 * Members of one message to many, at most, that are told what became of it.
 */
#define SINEW_MEMBERS_MAX 4096

/**
 * For `flags` of `sinew_field`: the field is an array; without `SINEW_FIELD_COUNTED` all of its elements are written and wanted.
 */
#define SINEW_FIELD_ARRAY 1

/**
 * For `flags` of `sinew_field`: a `size_t` at `extra_offset` says how many elements of the array are in use. Without it an array
 * has as many elements as fit.
 */
#define SINEW_FIELD_COUNTED 2

/**
 * For `flags` of `sinew_field`: a `bool` at `extra_offset` says whether the field has a value. It is `null` without one, and may be
 * missing in what is read. Rust's `Option`.
 */
#define SINEW_FIELD_OPTIONAL 4

/**
 * For `flags` of `sinew_barrier`: does not wait for the return of a party that is asked for by its name and has failed, was
 * stopped, or whose node is lost. Then `sinew_meet` returns `SINEW_ERROR_PARTY_LOST`.
 */
#define SINEW_FAIL_ON_LOSS 1

/**
 * For `flags` of `sinew_barrier`: a phase. Whoever has reached it counts until it is unregistered, also while it does something
 * else: an application that is started again goes on at once if the others are there.
 */
#define SINEW_PHASE 2

/**
 * For `events` of `sinew_options`: `sinew.node_event`, nodes that are found, lost, restarted.
 */
#define SINEW_NODE_EVENTS 1

/**
 * For `events` of `sinew_options`: `sinew.requirement_event`, what is required is lost or there again.
 */
#define SINEW_REQUIREMENT_EVENTS 2

/**
 * For `links` of `sinew_options`: through the unix socket alone, no shared memory.
 */
#define SINEW_SOCKET_ONLY 1

/**
 * For `links` of `sinew_options`: direct links to other processes that ask for them too.
 */
#define SINEW_DIRECT 2

/**
 * For `links` of `sinew_options`: `spin_ns` is the longest to look. It looks about twice as long as messages lately took to come,
 * and not at all while they take longer than `spin_ns`. Without `spin_ns` this does nothing.
 */
#define SINEW_SPIN_ADAPTIVE 4

/**
 * For `links` of `sinew_options`: does not register again when the connection to the node has ended. Then every call says
 * `SINEW_ERROR_CLOSED`. Without this the endpoint comes back by itself.
 */
#define SINEW_WITHOUT_RECONNECT 8

/**
 * Bytes before the payload of a sealed message.
 */
#define SINEW_SEALED_HEAD 32

/**
 * Bytes that sealing adds to a payload: 32 before it and 8 behind it.
 */
#define SINEW_SEALED_OVERHEAD 40

/**
 * What a call came to. Negative: an error, and `sinew_last_error` has a sentence about it.
 */
enum sinew_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * It is done.
     */
    SINEW_OK = 0,
    /**
     * No error, but nothing to hand out: no message came in time, or nobody has the name.
     */
    SINEW_NOTHING = 1,
    /**
     * An argument is NULL, no UTF-8, too long, or none of its legal values. Nothing was sent or registered.
     */
    SINEW_ERROR_INVALID_ARGUMENT = -1,
    /**
     * No node listens at the path, or this user may not connect. Nothing was done.
     */
    SINEW_ERROR_NO_NODE = -2,
    /**
     * The node refused the registration, or a wait at a barrier, in words. Nothing is registered.
     */
    SINEW_ERROR_REFUSED = -3,
    /**
     * What is required was not ready at the deadline. Nothing is registered.
     */
    SINEW_ERROR_WAITING = -4,
    /**
     * The node did not answer in time. Whether it did what was asked is not known.
     */
    SINEW_ERROR_NO_ANSWER = -5,
    /**
     * The connection to the node has ended, and the registration with it: unregister, then register again.
     */
    SINEW_ERROR_CLOSED = -6,
    /**
     * There was no room in time: the node or, on a direct link, the receiver is stopped or too slow. Nothing of the message
     * is received; it may be made and sent again.
     */
    SINEW_ERROR_STALLED = -7,
    /**
     * The payload is longer than `sinew_payload_max`. Nothing was sent.
     */
    SINEW_ERROR_TOO_LONG = -8,
    /**
     * A request was not handled, or a group not joined. The outcome and the sentence say why.
     */
    SINEW_ERROR_NOT_HANDLED = -9,
    /**
     * No reply came in time. The request may have been handled.
     */
    SINEW_ERROR_NO_REPLY = -10,
    /**
     * The message asks for no reply. Nothing was sent.
     */
    SINEW_ERROR_NOT_ASKED = -11,
    /**
     * What came is not what its kind says.
     */
    SINEW_ERROR_MALFORMED = -12,
    /**
     * This is no endpoint: it is NULL, or was unregistered, or never registered. Nothing was done.
     */
    SINEW_ERROR_NO_SUCH_ENDPOINT = -13,
    /**
     * Another thread is in a call on this endpoint. Nothing was done.
     */
    SINEW_ERROR_BUSY = -14,
    /**
     * This is no message of this endpoint: it was sent, discarded or settled already. Nothing was done.
     */
    SINEW_ERROR_NO_SUCH_MESSAGE = -15,
    /**
     * Too many endpoints in this process, or too many messages in hand. Nothing was sent or registered.
     */
    SINEW_ERROR_TOO_MANY = -16,
    /**
     * The endpoint belongs to the process that this one was forked from. Nothing was done.
     */
    SINEW_ERROR_FORKED = -17,
    /**
     * A fault of this library. The endpoint can only be unregistered; all others go on.
     */
    SINEW_ERROR_PANIC = -18,
    /**
     * A message is lent and was neither sent nor discarded: nothing else goes out of the endpoint before. Nothing was sent.
     */
    SINEW_ERROR_LOAN_ACTIVE = -19,
    /**
     * The connection to the node has ended, through no fault of this endpoint, which registers again by itself while it is
     * used: go on. Each send without a time tries, and `sinew_receive_message`, which says this once, waits for it. The message
     * was not sent.
     */
    SINEW_ERROR_DISCONNECTED = -20,
    /**
     * Not all parties were at the barrier in time. The sentence says who is missing; the others go on waiting.
     */
    SINEW_ERROR_NOT_MET = -21,
    /**
     * A party of the barrier was lost, and was not to be waited for. The sentence says which.
     */
    SINEW_ERROR_PARTY_LOST = -22,
    /**
     * This is no guard: it is NULL, or was released, or never made. Nothing was done.
     */
    SINEW_ERROR_NO_SUCH_GUARD = -23,
    /**
     * Too few good messages in a row have come, or the last one too long ago: the output cannot be armed yet. It stays safe.
     */
    SINEW_ERROR_NOT_GOOD = -24,
    /**
     * What makes the output safe says that it has failed: whether the output is safe is not known. It is called again each millisecond, until it has not.
     */
    SINEW_ERROR_SAFE_FAILS = -25,
    /**
     * What makes outputs safe in time cannot be started, or is not more urgent than the calling thread. No guard was made.
     */
    SINEW_ERROR_NO_WATCHDOG = -26,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_status sinew_status;
#else
typedef int32_t sinew_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * What became of a message.
 */
enum sinew_outcome
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * The destination has handled it.
     */
    SINEW_DELIVERED = 0,
    /**
     * Its time ran out before it was handled.
     */
    SINEW_EXPIRED = 1,
    /**
     * The destination failed, or ended with the message in hand.
     */
    SINEW_FAILED = 2,
    /**
     * The connection to its node was lost before it was sent: it was not handled.
     */
    SINEW_PEER_LOST = 3,
    /**
     * Nobody can say.
     */
    SINEW_UNKNOWN = 4,
    /**
     * Not handled: no application has this TID.
     */
    SINEW_REJECTED_NO_SUCH_APPLICATION = 16,
    /**
     * Not handled: the node is not known or not connected.
     */
    SINEW_REJECTED_NO_SUCH_NODE = 17,
    /**
     * Not handled: the destination does not handle this kind.
     */
    SINEW_REJECTED_UNKNOWN_KIND = 18,
    /**
     * Not handled: the payload is not what its kind says.
     */
    SINEW_REJECTED_MALFORMED = 19,
    /**
     * Not handled: a queue was full.
     */
    SINEW_REJECTED_QUEUE_FULL = 20,
    /**
     * Not handled: too long.
     */
    SINEW_REJECTED_TOO_LONG = 21,
    /**
     * Not handled: the application has ended.
     */
    SINEW_REJECTED_CLOSED = 22,
    /**
     * Not handled: the source is not the sender's.
     */
    SINEW_REJECTED_FORGED_SOURCE = 23,
    /**
     * Not handled: the handler refused it.
     */
    SINEW_REJECTED_BY_HANDLER = 24,
    /**
     * Not handled: this cannot be asked of this destination.
     */
    SINEW_REJECTED_UNSUPPORTED = 25,
    /**
     * Not handled: the application has ended and is not ready again.
     */
    SINEW_REJECTED_DOWN = 26,
    /**
     * Not handled: the access list of the destination's node does not allow it.
     */
    SINEW_REJECTED_NOT_ALLOWED = 27,
    /**
     * Not handled: a confirmed message to many has too many members or nodes, or too many of them are under way.
     */
    SINEW_REJECTED_TOO_MANY_MEMBERS = 28,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_outcome sinew_outcome;
#else
typedef int32_t sinew_outcome;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * Whether commands reach an output and, if not, since what.
 */
enum sinew_output_state
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * They do.
     */
    SINEW_LIVE = 0,
    /**
     * It was never armed.
     */
    SINEW_SAFE_NOT_ARMED = 1,
    /**
     * No good message came in time.
     */
    SINEW_SAFE_SILENT = 2,
    /**
     * More messages are missing in a row than is borne.
     */
    SINEW_SAFE_TOO_MUCH_LOST = 3,
    /**
     * More bad messages came than is borne.
     */
    SINEW_SAFE_TOO_MANY_BAD = 4,
    /**
     * The sender counts anew: it was restarted.
     */
    SINEW_SAFE_RESTARTED = 5,
    /**
     * The receiver's host has slept: how old commands are that came meanwhile is not known.
     */
    SINEW_SAFE_SLEPT = 6,
    /**
     * `sinew_trip` was called, or the guard's endpoint was unregistered.
     */
    SINEW_SAFE_TRIPPED = 7,
    /**
     * The guard is being released.
     */
    SINEW_SAFE_RELEASED = 8,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_output_state sinew_output_state;
#else
typedef int32_t sinew_output_state;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * What is wrong with a protected message.
 */
enum sinew_sealed_fault
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Nothing.
     */
    SINEW_FAULT_NONE = 0,
    /**
     * Its bytes are not those that were sealed for this receiver by this sender: damaged, inserted, or meant for another.
     */
    SINEW_FAULT_CORRUPT = 1,
    /**
     * It quotes no time of this receiver's, or one that is too long ago.
     */
    SINEW_FAULT_TOO_OLD = 2,
    /**
     * It has come before.
     */
    SINEW_FAULT_REPEATED = 3,
    /**
     * One that was sent later has come before it.
     */
    SINEW_FAULT_BACKWARDS = 4,
    /**
     * Its sender counts anew: another incarnation than that of the last one.
     */
    SINEW_FAULT_RESTARTED = 5,
    /**
     * Too many before it are missing.
     */
    SINEW_FAULT_GAP = 6,
    /**
     * It is what was sealed, and its payload is not as long as the type says.
     */
    SINEW_FAULT_UNREADABLE = 7,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_sealed_fault sinew_sealed_fault;
#else
typedef int32_t sinew_sealed_fault;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * How urgent a message is, and what a newer one does to an older.
 */
enum sinew_message_class
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * In order, and ahead of all else.
     */
    SINEW_CONTROL = 0,
    /**
     * Of each source and kind only the newest value: a late setpoint is a hazard. Cannot be confirmed.
     */
    SINEW_STREAM = 1,
    /**
     * In order; gives way to the others.
     */
    SINEW_BULK = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_message_class sinew_message_class;
#else
typedef int32_t sinew_message_class;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * The type of a field, and of the elements of one that is an array. C has `SINEW_FIELD`, which finds it by itself.
 */
enum sinew_field_type
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * `bool`.
     */
    SINEW_TYPE_BOOL = 1,
    /**
     * `int8_t`.
     */
    SINEW_TYPE_I8 = 2,
    /**
     * `int16_t`.
     */
    SINEW_TYPE_I16 = 3,
    /**
     * `int32_t`.
     */
    SINEW_TYPE_I32 = 4,
    /**
     * `int64_t`.
     */
    SINEW_TYPE_I64 = 5,
    /**
     * `uint8_t`.
     */
    SINEW_TYPE_U8 = 6,
    /**
     * `uint16_t`.
     */
    SINEW_TYPE_U16 = 7,
    /**
     * `uint32_t`.
     */
    SINEW_TYPE_U32 = 8,
    /**
     * `uint64_t`.
     */
    SINEW_TYPE_U64 = 9,
    /**
     * `float`.
     */
    SINEW_TYPE_F32 = 10,
    /**
     * `double`.
     */
    SINEW_TYPE_F64 = 11,
    /**
     * An array of `char`: UTF-8 that ends with a zero.
     */
    SINEW_TYPE_TEXT = 12,
    /**
     * An array of `uint8_t` that is written as bytes, not as a list of numbers.
     */
    SINEW_TYPE_BYTES = 13,
    /**
     * A struct that has a table of its own.
     */
    SINEW_TYPE_STRUCT = 14,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_field_type sinew_field_type;
#else
typedef uint32_t sinew_field_type;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * An endpoint: a transport address of this process. Only pointers to it are handed out.
 */
typedef struct sinew_endpoint sinew_endpoint;

/**
 * The only way to an output. Only pointers to it are handed out.
 */
typedef struct sinew_guard sinew_guard;

/**
 * A text: UTF-8, not ended by a zero. `SINEW_TEXT("...")` makes one of a literal, `sinew_text_of` of a C string.
 */
typedef struct sinew_text {
    /**
     * Its first byte; may be NULL if the length is 0.
     */
    const char *bytes;
    /**
     * Its length in bytes, a zero at its end not counted.
     */
    size_t length;
} sinew_text;

/**
 * What an application asks for when it registers. Set all of it to zero, then `size`, then what is wanted; zero means the
 * default everywhere. It grows at its end only: a program that was compiled with a shorter one is served as before.
 */
typedef struct sinew_options {
    /**
     * `sizeof(sinew_options)`, by which the library knows what the program was compiled with.
     */
    size_t size;
    /**
     * The name, 1 to 63 bytes without control characters, unique on the node. Default: none.
     */
    struct sinew_text name;
    /**
     * What must be met, on this node or any, before this application is ready: `knee.drive`, `*.drive`, `hip.imu | knee.imu`,
     * `2 of *.drive`, `knee.drive at homed`, `camera ?2s`. At most 64. Default: none.
     */
    const struct sinew_text *required;
    /**
     * How many.
     */
    size_t required_count;
    /**
     * Names of the payload types that the application sends or handles, so that two which hash alike are found at
     * registration. At most 64. Default: none.
     */
    const struct sinew_text *handled;
    /**
     * How many.
     */
    size_t handled_count;
    /**
     * A fixed address, `0x1000` to `0x7fffffff`. Default: a dynamic one.
     */
    uint32_t fixed_address;
    /**
     * The events of the node's layers to be received: `SINEW_NODE_EVENTS`, `SINEW_REQUIREMENT_EVENTS`. Default: none.
     */
    uint32_t events;
    /**
     * How long the registration may take, waiting for what is required included. Default: 60 s.
     */
    uint64_t deadline_ns;
    /**
     * How long a send waits while the node or, on a direct link, the receiver takes nothing; whatever it takes begins that time
     * anew. Default: 1 s. For one send alone, and in all: `sinew_room_within`.
     */
    uint64_t stall_timeout_ns;
    /**
     * How many received messages wait in this process until no more are taken out of the socket or the rings; more while an
     * answer is waited for. Default: 256.
     */
    size_t inbox_capacity;
    /**
     * How long a thread that waits at a ring looks at it before it sleeps; at a socket (`SINEW_SOCKET_ONLY`) it never looks.
     * Looking keeps a CPU busy and saves the wake, which is most of a short message's way: for a thread with a CPU of its
     * own. Default: it sleeps at once.
     */
    uint64_t spin_ns;
    /**
     * What carries the messages: `SINEW_SOCKET_ONLY`, `SINEW_DIRECT`, `SINEW_SPIN_ADAPTIVE`, `SINEW_WITHOUT_RECONNECT`. Default:
     * shared memory where the system has it, all through the node, and again when the connection has ended.
     */
    uint32_t links;
    /**
     * Zero.
     */
    uint32_t reserved;
    /**
     * Bytes of this side's ring of each direct link, from 4 KiB to 1 MiB (less or more is taken for those), rounded up to a
     * power of two and never more than the node's `lncl.ring_bytes`. A message longer than half of it goes in pieces. All
     * rings for direct links that a process makes take 64 MiB at most. Default: 64 KiB.
     */
    size_t direct_ring_bytes;
} sinew_options;

/**
 * A transport ID (TID): the node's address in the upper half, the application's in the lower. 0 is nobody.
 */
typedef uint64_t sinew_tid;

/**
 * Type of a payload: see `sinew_kind_named`.
 */
typedef uint32_t sinew_kind;

/**
 * A message that is being made. `bytes` is writable until it is sent or discarded; do not change the other fields.
 */
typedef struct sinew_message {
    /**
     * Its payload, all zeros at first.
     */
    uint8_t *bytes;
    /**
     * Length of the payload in bytes.
     */
    size_t length;
    /**
     * For the library: by this it knows the message again.
     */
    uint64_t token;
} sinew_message;

/**
 * What became of a message to many at one of its members.
 */
typedef struct sinew_member_outcome {
    /**
     * The member. Where a node has not named its members: its node, and the application address that the message was sent to.
     */
    sinew_tid tid;
    /**
     * One of `sinew_outcome`.
     */
    int32_t outcome;
    /**
     * Zero.
     */
    uint32_t reserved;
} sinew_member_outcome;

/**
 * A message that was received. `bytes` is readable until it is settled; do not change the fields.
 */
typedef struct sinew_received {
    /**
     * Its payload.
     */
    const uint8_t *bytes;
    /**
     * Length of the payload in bytes.
     */
    size_t length;
    /**
     * Who sent it; the sender's node answers for it.
     */
    sinew_tid source;
    /**
     * Whom it was sent to: this endpoint, a group, or everybody.
     */
    sinew_tid destination;
    /**
     * The source's n-th message, from 1.
     */
    uint64_t sequence;
    /**
     * When it was sent, on the clock of `sinew_now_ns`, as wrong as `sent_error_ns` says. It has a meaning if `is_sent_known` alone. For an age
     * take `sinew_age`, `sinew_age_at_most` or `sinew_is_older_than`.
     */
    uint64_t sent_ns;
    /**
     * The error of `sent_ns` at most, if `is_sent_known`: 0 for a message of this host. It grows while the clock of the sender's host is not
     * measured.
     */
    uint64_t sent_error_ns;
    /**
     * For the library: by this it knows the message again.
     */
    uint64_t token;
    /**
     * Type of the payload: compare it with `sinew_kind_named`.
     */
    sinew_kind kind;
    /**
     * One of `sinew_message_class`.
     */
    uint8_t message_class;
    /**
     * Whether the sender waits for `sinew_reply`.
     */
    bool wants_reply;
    /**
     * Whether `sent_ns` is known. Not, while the clock of the sender's host is not measured, or may be wrong by more than 32 s.
     */
    bool is_sent_known;
    /**
     * Zero.
     */
    uint8_t reserved;
} sinew_received;

/**
 * Unconfirmed messages to one destination, of one type, that were not delivered for one reason.
 */
typedef struct sinew_undelivered {
    /**
     * Destination; 0: several that are not told apart any more.
     */
    sinew_tid destination;
    /**
     * Number of messages since the last report. Never 0.
     */
    uint64_t count;
    /**
     * When the first of these was refused, on the clock of `sinew_now_ns`.
     */
    uint64_t since_ns;
    /**
     * Lowest sequence of these messages, if `are_sequences_known`.
     */
    uint64_t first_sequence;
    /**
     * Highest sequence of these messages, if `are_sequences_known`.
     */
    uint64_t last_sequence;
    /**
     * Reason: one of `sinew_outcome`. `SINEW_REJECTED_UNKNOWN_KIND`: the destination does not handle this type.
     */
    int32_t outcome;
    /**
     * Type of the payload; 0: several, or not known.
     */
    sinew_kind kind;
    /**
     * One of `sinew_message_class`, of the first message; -1 where it is not known.
     */
    int32_t message_class;
    /**
     * Name of the destination, of at most 63 bytes, with a zero behind it; empty where it is not known.
     */
    char name[64];
    /**
     * Whether `first_sequence` and `last_sequence` are known.
     */
    bool are_sequences_known;
    /**
     * Zero.
     */
    uint8_t reserved[7];
} sinew_undelivered;

/**
 * A field of a struct. C: one of the macros `SINEW_FIELD`, `SINEW_FIELD_LIST`, `SINEW_FIELD_MAYBE`, `SINEW_FIELD_STRUCT`,
 * `SINEW_FIELD_STRUCTS`, `SINEW_FIELD_BYTES`. C++: `SINEW_PAYLOAD` and `SINEW_STRUCT` of sinew.hpp write the whole table.
 */
typedef struct sinew_field {
    /**
     * Its name in the payload, a C string.
     */
    const char *name;
    /**
     * Where it is in the struct, in bytes.
     */
    size_t offset;
    /**
     * Its length in bytes, with all elements of an array.
     */
    size_t size;
    /**
     * Where its count or its `bool` is: see `flags`.
     */
    size_t extra_offset;
    /**
     * The table of its struct, for `SINEW_TYPE_STRUCT`; else NULL.
     */
    const struct sinew_layout *layout;
    /**
     * One of `sinew_field_type`.
     */
    uint32_t field_type;
    /**
     * `SINEW_FIELD_ARRAY`, `SINEW_FIELD_COUNTED`, `SINEW_FIELD_OPTIONAL`.
     */
    uint32_t flags;
} sinew_field;

/**
 * The table of a struct's fields. C: `SINEW_LAYOUT`.
 */
typedef struct sinew_layout {
    /**
     * Its fields, 64 at most.
     */
    const struct sinew_field *fields;
    /**
     * How many there are.
     */
    size_t fields_count;
    /**
     * Length of the struct in bytes.
     */
    size_t size;
} sinew_layout;

/**
 * A type of payloads: its name, the class in which it is sent, its fields, and its time to live. C: `SINEW_PAYLOAD`,
 * `SINEW_PAYLOAD_EXPIRING`.
 */
typedef struct sinew_payload_type {
    /**
     * Its name, the same in every program and language.
     */
    struct sinew_text name;
    /**
     * One of `sinew_message_class`.
     */
    int32_t message_class;
    /**
     * Its fields.
     */
    struct sinew_layout layout;
    /**
     * Time to live: a message that is older expires where it waits, and is not received. 0: it has none. At most 71 minutes and 35 s: more
     * counts as that.
     */
    uint64_t expires_after_ns;
} sinew_payload_type;

/**
 * A barrier: where several applications, on any nodes, wait for each other. It need not be made, and can be used again and
 * again. Set all of it to zero, then what is wanted. All that meet say the same name and the same parties.
 */
typedef struct sinew_barrier {
    /**
     * Its name, 1 to 63 bytes; of a phase one word.
     */
    struct sinew_text name;
    /**
     * Who has to be there: `knee.drive`, `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `3 of *`. At most 64. Whoever waits must
     * be one of them.
     */
    const struct sinew_text *parties;
    /**
     * How many.
     */
    size_t parties_count;
    /**
     * How long to wait, rounded up to milliseconds. Default: 60 s.
     */
    uint64_t within_ns;
    /**
     * `SINEW_FAIL_ON_LOSS`, `SINEW_PHASE`. Default: neither.
     */
    uint32_t flags;
    /**
     * Zero.
     */
    uint32_t reserved;
} sinew_barrier;

/**
 * A type of payloads that are protected: what it is called, and what a receiver bears. Both ends use the same one, best from a header of theirs;
 * in Rust it is `Payload::NAME` and `Payload::PROTECTION`. `sinew_protected_type_of` fills all of it.
 */
typedef struct sinew_protected_type {
    /**
     * Its name, at least 1 byte.
     */
    struct sinew_text name;
    /**
     * Length of each payload in bytes, `sizeof` of a plain struct: one of another length is not sent, and is a bad one where it comes. 0: any. It is all
     * that a guard looks at of a payload: whoever cannot read one that came through it calls `sinew_trip`, or it keeps the output live for ever.
     */
    size_t length;
    /**
     * Longest time from one good message to the next, above 0: then the output is made safe.
     */
    uint64_t within_ns;
    /**
     * Greatest age of a message, at least 4 ns: from an echo that the receiver has sent to the moment at which the message that quotes it arrives.
     */
    uint64_t age_max_ns;
    /**
     * Messages that may be missing in a row.
     */
    uint64_t lost_max;
    /**
     * Bad ones that may be among the last 64; none of them is used.
     */
    uint32_t bad_max;
    /**
     * Good ones in a row before the output may be armed, at least 1.
     */
    uint32_t good_min;
    /**
     * One of `sinew_message_class`, for the sender. Of `SINEW_STREAM` only the newest one may arrive: those that it replaces are missing ones.
     */
    int32_t message_class;
    /**
     * Zero.
     */
    uint32_t reserved;
} sinew_protected_type;

/**
 * What a flow of protected messages is called by both of its ends. It is not sent: whoever is not meant computes another checksum.
 */
typedef struct sinew_data_id {
    /**
     * Who sends: its whole TID, the node's address included.
     */
    sinew_tid source;
    /**
     * Who receives, as well; one application.
     */
    sinew_tid destination;
    /**
     * Name of the payload's type.
     */
    struct sinew_text name;
} sinew_data_id;

/**
 * What the sender says of one protected message.
 */
typedef struct sinew_stamp {
    /**
     * Counts the messages of the flow, from 1.
     */
    uint64_t counter;
    /**
     * Which life of the sender counts: never the same one twice. `sinew_now_ns` at its beginning will do.
     */
    uint64_t incarnation;
    /**
     * The newest time that the sender has heard from the receiver (`sinew_guard_echo`); 0 for none.
     */
    uint64_t echo_ns;
} sinew_stamp;

/**
 * Makes an output safe, and returns 0; anything else says that it could not, and it is called again each millisecond. Any thread calls it, mostly one of
 * the library's own: it must be short and wait for nobody, as the outputs of all guards wait for it. It must return, by no exception and no `longjmp`, and
 * may call nothing of a guard but `sinew_trip` and `sinew_release_later`, and no `sinew_receive_message` of an endpoint that sends or receives protected
 * payloads: `SINEW_ERROR_BUSY`.
 */
typedef int32_t (*sinew_make_safe)(void *output, sinew_output_state why);

/**
 * Moves an output that is live; what makes it safe waits meanwhile. It must return as `sinew_make_safe`, and soon, and may call as little.
 */
typedef void (*sinew_command)(void *output, void *argument);

/**
 * What a guard has counted.
 */
typedef struct sinew_tally {
    /**
     * Good messages.
     */
    uint64_t good;
    /**
     * Those of `SINEW_FAULT_CORRUPT`.
     */
    uint64_t corrupt;
    /**
     * Those of `SINEW_FAULT_TOO_OLD`.
     */
    uint64_t too_old;
    /**
     * Those of `SINEW_FAULT_REPEATED`.
     */
    uint64_t repeated;
    /**
     * Those of `SINEW_FAULT_BACKWARDS`.
     */
    uint64_t backwards;
    /**
     * Those of `SINEW_FAULT_RESTARTED`.
     */
    uint64_t restarted;
    /**
     * Those of `SINEW_FAULT_GAP`.
     */
    uint64_t gaps;
    /**
     * Those of `SINEW_FAULT_UNREADABLE`.
     */
    uint64_t unreadable;
    /**
     * Messages that are missing, by their numbers.
     */
    uint64_t lost;
    /**
     * How often the output went from live to safe.
     */
    uint64_t trips;
} sinew_tally;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * The `SINEW_ABI` that the library was built with. A program that loads the library at run time compares. Any thread.
 */
uint32_t sinew_abi(void);

/**
 * Connects to the node whose configuration's `lncl.socket` is `socket`, asks for a transport address, and waits until
 * everything that is required is ready (the paper's RegisterTransportAddress). `options` may be NULL: a dynamic address,
 * no name. Any thread, any number at the same time. Blocks until the deadline of the options at most.
 *
 * The endpoint is one thread's at a time. A process may have 256, if its node lets it: `lncl.clients_per_process_max`, 64.
 */
sinew_status sinew_register_transport_address(struct sinew_text socket,
                                              const struct sinew_options *options,
                                              struct sinew_endpoint **endpoint);

/**
 * Gives the address back, and waits until the node has taken it, 2 s at most: then the name is free. Whatever it returns,
 * but for `SINEW_ERROR_BUSY` and `SINEW_ERROR_FORKED`, the endpoint is gone and `*endpoint` is NULL. Messages that were
 * received and not settled end as Failed; one that was made and not sent is discarded; the memory of both is gone. The
 * endpoint's thread, or any when no other one is in a call on it.
 */
sinew_status sinew_unregister(struct sinew_endpoint **endpoint);

/**
 * The address that was registered; 0 if this is no endpoint or another thread is in a call on it. The endpoint's thread.
 */
sinew_tid sinew_endpoint_tid(const struct sinew_endpoint *endpoint);

/**
 * Longest payload that the node takes, in bytes; 0 if this is no endpoint or another thread is in a call on it. The
 * endpoint's thread.
 */
size_t sinew_payload_max(const struct sinew_endpoint *endpoint);

/**
 * The name of the node, ended by a zero, until the endpoint is unregistered; NULL if this is no endpoint or another thread
 * is in a call on it. The endpoint's thread; what it points to, any.
 */
const char *sinew_node_name(const struct sinew_endpoint *endpoint);

/**
 * Asks who has `name` now, on any node; waits `within_ns` at most. `SINEW_NOTHING` and a `*tid` of 0 if nobody has it.
 * The endpoint's thread.
 */
sinew_status sinew_resolve(struct sinew_endpoint *endpoint,
                           struct sinew_text name,
                           uint64_t within_ns,
                           sinew_tid *tid);

/**
 * Joins a group: what is sent to `sinew_group` of this name reaches this endpoint from now on. Waits 2 s at most. The
 * endpoint's thread.
 */
sinew_status sinew_join_group(struct sinew_endpoint *endpoint,
                              struct sinew_text name);

/**
 * Leaves a group. Waits 2 s at most. The endpoint's thread.
 */
sinew_status sinew_leave_group(struct sinew_endpoint *endpoint, struct sinew_text name);

/**
 * The members of the group called `name`, on every node; 0 if it is no text. Any thread.
 */
sinew_tid sinew_group(struct sinew_text name);

/**
 * The kind of the payload type called `name`, the same in every program and language; 0 if it is no text.
 * Any thread.
 */
sinew_kind sinew_kind_named(struct sinew_text name);

/**
 * The TID that is written in `text`, as in `10.0.0.7/1001`. Any thread.
 */
sinew_status sinew_tid_parse(struct sinew_text text, sinew_tid *tid);

/**
 * Writes a TID as text, ended by a zero, into `capacity` bytes; `SINEW_TID_TEXT` are always enough. Any
 * thread.
 */
sinew_status sinew_tid_text(sinew_tid tid, char *text, size_t capacity);

/**
 * The present moment in nanoseconds of the host's monotonic clock: the clock of `sent_ns`. Any thread.
 */
uint64_t sinew_now_ns(void);

/**
 * Lends `length` writable bytes, all zeros, for a payload of `kind` to `destination` (the paper's CreateMessage).
 * `message_class` is one of `sinew_message_class`. Does not block. The endpoint's thread; the bytes, any.
 *
 * An endpoint lends one message at a time, and until that is sent or discarded nothing else goes out of it: to create
 * another, to send, ask, reply, resolve, join and leave return `SINEW_ERROR_LOAN_ACTIVE`, whatever carries the messages; what
 * `sinew_settle_message` says may wait. So write it at once. The bytes lie in the shared memory from which they are read, if there
 * is room: then sending copies nothing. Else they are ordinary memory. If the process is killed meanwhile, nobody notices more
 * than its end.
 */
sinew_status sinew_create_message(struct sinew_endpoint *endpoint,
                                  sinew_tid destination,
                                  sinew_kind kind,
                                  int32_t message_class,
                                  size_t length,
                                  struct sinew_message *message);

/**
 * Gives a message back that is not to be sent. `*message` is all zeros then. Does not block. The endpoint's thread.
 */
sinew_status sinew_discard_message(struct sinew_endpoint *endpoint,
                                   struct sinew_message *message);

/**
 * Has a message that is being made expire where it waits when it is older than `time_ns`, instead of its type's time to live. An unconfirmed message
 * without one waits for ever; a confirmed one and a request live no longer than they are waited for. At most 71 minutes and 35 s: more counts
 * as that. 0 is `SINEW_ERROR_INVALID_ARGUMENT`. Does not block. The endpoint's thread.
 */
sinew_status sinew_expires_after(struct sinew_endpoint *endpoint,
                                 const struct sinew_message *message,
                                 uint64_t time_ns);

/**
 * Has the sending of a message that is being made wait for room no longer than `within_ns`, in place of the `stall_timeout_ns` of the options; with 0 it
 * does not wait at all. For a control loop: `SINEW_ERROR_STALLED` says that there was no room in time and that nothing of the message is received.
 * One that is longer than the ring needs a time in which its receiver takes some of it (with `SINEW_SOCKET_ONLY` it is sent with its first byte,
 * and the rest follows with later calls). A node that has gone is not looked for while the message is sent (`SINEW_ERROR_DISCONNECTED`):
 * `sinew_receive_message`, or a send without such a time, does. Does not block. The endpoint's thread.
 */
sinew_status sinew_room_within(struct sinew_endpoint *endpoint,
                               const struct sinew_message *message,
                               uint64_t within_ns);

/**
 * Sends a message (the paper's SendMessage). What becomes of it then is not told. The message is gone when this returns, sent
 * or not: see Messages at the top. Blocks while there is no room and nothing is taken, for the `stall_timeout_ns` of the
 * options, or as `sinew_room_within` says. The endpoint's thread.
 */
sinew_status sinew_send_message(struct sinew_endpoint *endpoint,
                                struct sinew_message *message);

/**
 * Lends, copies and sends in one call. `bytes` may be NULL if `length` is 0. Blocks as `sinew_send_message`. The endpoint's
 * thread.
 */
sinew_status sinew_send_bytes(struct sinew_endpoint *endpoint,
                              sinew_tid destination,
                              sinew_kind kind,
                              int32_t message_class,
                              const void *bytes,
                              size_t length);

/**
 * Sends a message and waits for what becomes of it; `SINEW_UNKNOWN` when nobody has said so after `within_ns`. The message
 * expires where it waits when it is older. `*outcome` is set if this returns `SINEW_OK`. The message is gone as with
 * `sinew_send_message`. What comes meanwhile waits to be received. Blocks for `within_ns` at most, room included; a longer one
 * counts as the longest time to live of a message, 71 minutes and 35 s. With less than 20 ms a node that has gone is not looked
 * for here (`SINEW_ERROR_DISCONNECTED`): `sinew_receive_message` does. The endpoint's thread.
 */
sinew_status sinew_send_message_confirmed(struct sinew_endpoint *endpoint,
                                          struct sinew_message *message,
                                          uint64_t within_ns,
                                          sinew_outcome *outcome);

/**
 * Sends a message to a group, to every application or to an address on all nodes, and waits for what becomes of it at each member that is
 * known when the message arrives at its node, without this endpoint. Returns as soon as the last one is settled, and after `within_ns` at
 * the latest: `SINEW_UNKNOWN` of a member without an outcome by then. The first `capacity` of them, in the order of their TIDs, are written
 * to `members`, which may be NULL where that is 0; `*count` is the number of all, `SINEW_MEMBERS_MAX` at most, and 0 for a group without
 * members. Both are set if this returns `SINEW_OK`. `SINEW_ERROR_NOT_HANDLED`: no member has a copy. All else is as with
 * `sinew_send_message_confirmed`. The endpoint's thread.
 */
sinew_status sinew_send_message_confirmed_by_each(struct sinew_endpoint *endpoint,
                                                  struct sinew_message *message,
                                                  uint64_t within_ns,
                                                  struct sinew_member_outcome *members,
                                                  size_t capacity,
                                                  size_t *count);

/**
 * Sends a message as a request, in class Control, and waits for the reply, `within_ns` at most, room included. `*reply` is
 * set if this returns `SINEW_OK`; settle it when it has been read. If it returns `SINEW_ERROR_NOT_HANDLED` and `outcome` is not
 * NULL, `*outcome` says what became of the request. With 1024 received messages in hand there is no place for a reply:
 * `SINEW_ERROR_TOO_MANY`, and nothing was sent. The message is gone as with `sinew_send_message`. A longer `within_ns` counts as
 * the longest time to live of a message, 71 minutes and 35 s; with less than 20 ms a node that has gone is not looked for here, as with
 * `sinew_send_message_confirmed`. The endpoint's thread.
 */
sinew_status sinew_ask(struct sinew_endpoint *endpoint,
                       struct sinew_message *message,
                       uint64_t within_ns,
                       struct sinew_received *reply,
                       sinew_outcome *outcome);

/**
 * Sends a message as the reply to a request in hand; it goes to who asked, whatever destination it was created for. The
 * request is still to be settled. The message is gone as with `sinew_send_message`, as which it blocks. The endpoint's thread.
 */
sinew_status sinew_reply(struct sinew_endpoint *endpoint,
                         const struct sinew_received *request,
                         struct sinew_message *message);

/**
 * Waits for a message, `within_ns` at most; `SINEW_NOTHING` if none came (the paper's ReceiveMessage). Control comes first,
 * then Stream, of which only the newest value of each source and kind, then Bulk. `*received` is set if this returns
 * `SINEW_OK`; settle it when it has been handled. Up to 1024 may be in hand; one more is `SINEW_ERROR_TOO_MANY`, and stays
 * where it waits. With 0 it only looks. `SINEW_ERROR_BUSY` where a guard calls the program, if anything protected was sent or guarded here. The endpoint's
 * thread.
 *
 * Signals do not end the wait: a loop that is to end at one takes a short `within_ns` and looks each time.
 */
sinew_status sinew_receive_message(struct sinew_endpoint *endpoint,
                                   uint64_t within_ns,
                                   struct sinew_received *received);

/**
 * Gives the next report of unconfirmed messages that were not delivered, by this node or another: one for each destination, type and
 * reason, with the number of messages; `SINEW_NOTHING` if there is nothing new. Does not block. The first refusal is reported at once,
 * later ones every 100 ms together. `*undelivered` is set if this returns `SINEW_OK`. What
 * this endpoint itself has refused, since it came while an answer was waited for and was more than is kept then (16,384 messages
 * of each class, 4 MiB and one message), is counted with its own TID as the destination. The endpoint's thread.
 */
sinew_status sinew_next_undelivered(struct sinew_endpoint *endpoint,
                                    struct sinew_undelivered *undelivered);

/**
 * Gives the time since a message was sent, as wrong as its `sent_error_ns` says. Returns whether that is known, and leaves `*age_ns` as it is where
 * it is not: the clock of the sender's host is not measured yet, or may be wrong by more than 32 s. Any thread.
 */
bool sinew_age(const struct sinew_received *received,
               uint64_t *age_ns);

/**
 * Gives the greatest age that a message can have: its age and the error of that. Returns whether that is known, and leaves `*age_ns` as it is
 * where it is not. Any thread.
 */
bool sinew_age_at_most(const struct sinew_received *received,
                       uint64_t *age_ns);

/**
 * Whether a message may be older than `limit_ns`: for a program that may use fresh values only. An unknown age counts as too old, and so does
 * NULL. Any thread.
 */
bool sinew_is_older_than(const struct sinew_received *received,
                         uint64_t limit_ns);

/**
 * Says what became of a message in hand, which its sender is told if it asked, and gives its memory back. `outcome` is
 * `SINEW_DELIVERED` if it was handled, `SINEW_FAILED`, or one of the rejections. `*received` is all zeros then; after
 * an error it is still in hand. The endpoint's thread. Does not block.
 */
sinew_status sinew_settle_message(struct sinew_endpoint *endpoint,
                                  struct sinew_received *received,
                                  int32_t outcome);

/**
 * Creates a message with a typed value: `*value` is a struct of this type. Its class and its time to live are the type's, its bytes are MessagePack with the
 * names of the fields, which Rust reads as the `payload!` of the same name. Hand it to any function that sends, as one of
 * `sinew_create_message`. `SINEW_ERROR_INVALID_ARGUMENT` with the field's name where the value cannot be written: a text that is
 * not UTF-8, a count above the array. Does not block. The endpoint's thread.
 */
sinew_status sinew_create_value(struct sinew_endpoint *endpoint,
                                sinew_tid destination,
                                const struct sinew_payload_type *payload_type,
                                const void *value,
                                struct sinew_message *message);

/**
 * Reads a received message as a typed value: `*value` is a struct of this type, which is written if this returns `SINEW_OK`.
 * `SINEW_NOTHING` if the message is of another kind. `SINEW_ERROR_MALFORMED` with the field's name if it cannot be read: a field
 * that is missing, of another type, or whose value does not fit. Settle the message then as `SINEW_REJECTED_MALFORMED`. Fields
 * that the type does not have are skipped. Any thread.
 */
sinew_status sinew_read_value(const struct sinew_received *received,
                              const struct sinew_payload_type *payload_type,
                              void *value);

/**
 * Writes a typed value as MessagePack to `bytes`, which has room for `room` bytes, for a protected payload, a file, or a bus of
 * your own. `*length` is the length that the value has, also where this returns `SINEW_ERROR_TOO_LONG`, since there is less
 * room. `bytes` may be NULL if `room` is 0. Any thread.
 */
sinew_status sinew_encode_value(const struct sinew_payload_type *payload_type,
                                const void *value,
                                uint8_t *bytes,
                                size_t room,
                                size_t *length);

/**
 * Reads a typed value from MessagePack, as `sinew_read_value` does from a message. Any thread.
 */
sinew_status sinew_decode_value(const struct sinew_payload_type *payload_type,
                                const uint8_t *bytes,
                                size_t length,
                                void *value);

/**
 * Arrives at a barrier and waits until all parties have, `within_ns` of the barrier at most. `*generation` is how often the barrier
 * has opened then, the same number for all that went on together (of a phase 1); `generation` may be NULL. What comes meanwhile waits
 * to be received. `SINEW_ERROR_NOT_MET`: not all came in time; `SINEW_ERROR_PARTY_LOST`: one was lost and was not to be waited for;
 * the sentence of both says who is missing, and why. `SINEW_ERROR_REFUSED`: this endpoint is none of the parties, or the barrier is
 * none, in words. After any other error it counts as arrived until the barrier's time is over. The endpoint's thread.
 */
sinew_status sinew_meet(struct sinew_endpoint *endpoint,
                        const struct sinew_barrier *barrier,
                        uint64_t *generation);

/**
 * A type of payloads that are protected, for a message each `period_ns`: two may be late or missing, one in 64 bad, and the output may be armed
 * after eight good ones; a message is too old after eight periods. As `Protection::of_period` in Rust. `length` is that of each payload in bytes,
 * 0 for any; class Control. `name` is kept as a pointer. Any thread.
 */
struct sinew_protected_type sinew_protected_type_of(struct sinew_text name,
                                                    size_t length,
                                                    uint64_t period_ns);

/**
 * Seals a payload and sends it, to one application: what it moves there moves for no other one. Counter, life and the echo are added by the
 * library; echoes come while this endpoint is in `sinew_receive_message`, so call that at least four times in `age_max_ns`, with 0 if nothing is to be
 * waited for: without an echo the receiver takes each message for too old. The payload is at most `sinew_payload_max` less `SINEW_SEALED_OVERHEAD` bytes
 * long. An endpoint goes on with 1,024 flows at most, of one type to one receiver each: one more is `SINEW_ERROR_TOO_MANY`. Blocks as
 * `sinew_send_message`. The endpoint's thread.
 */
sinew_status sinew_send_protected(struct sinew_endpoint *endpoint,
                                  sinew_tid destination,
                                  const struct sinew_protected_type *payload_type,
                                  const void *bytes,
                                  size_t length);

/**
 * The same, and waits for room as `sinew_room_within` says. What was not sent counts as missing at the receiver. The endpoint's thread.
 */
sinew_status sinew_send_protected_within(struct sinew_endpoint *endpoint,
                                         sinew_tid destination,
                                         const struct sinew_protected_type *payload_type,
                                         const void *bytes,
                                         size_t length,
                                         uint64_t within_ns);

/**
 * Seals a payload for who sends over something else than an endpoint, and keeps the counter itself: writes
 * `length + SINEW_SEALED_OVERHEAD` bytes to `sealed`, whose `capacity` is at least that. The two must not overlap. Any thread.
 */
sinew_status sinew_seal(const struct sinew_data_id *data_id,
                        const struct sinew_stamp *stamp,
                        const void *bytes,
                        size_t length,
                        uint8_t *sealed,
                        size_t capacity);

/**
 * Looks whether these bytes were sealed under this data ID, and what their sender says of them; the payload begins at `SINEW_SEALED_HEAD`
 * and is `SINEW_SEALED_OVERHEAD` bytes shorter than `length`. `SINEW_ERROR_MALFORMED` if not. This alone protects from nothing but damage and wrong addresses:
 * to act on a message let a guard take it, `sinew_check_sealed`. Any thread.
 */
sinew_status sinew_unseal(const struct sinew_data_id *data_id,
                          const void *sealed,
                          size_t length,
                          struct sinew_stamp *stamp);

/**
 * Has `output` moved by what `source` sends to this endpoint of a protected type, and made safe by `safe` when that is not as it has to be: at once, since
 * it is not armed, and whenever it is not live any more. From now on `sinew_receive_message` hands out of that type only messages of this sender's that are
 * good, and that come while the output is live, without their envelopes; others are refused and counted. Act on them in `sinew_apply` alone.
 *
 * The sender is told what it has to quote while this endpoint is in `sinew_receive_message`: call that at least four times in `age_max_ns`. An endpoint
 * that came back to another address, or whose sender did, makes its guards anew. `output` may be NULL, and must be there until `sinew_release`
 * has let go of it; release it before the end of `main`, too. A process has 256 guards at most; its first one starts the thread `safe-output`,
 * which keeps the watchdogs with a real-time priority of 90, or the highest that is granted (`ulimit -r`). `SINEW_ERROR_SAFE_FAILS`: `safe` has failed at
 * once and is tried on; the guard is made all the same, and `*guard` set. The endpoint's thread.
 */
sinew_status sinew_guard_output(struct sinew_endpoint *endpoint,
                                sinew_tid source,
                                const struct sinew_protected_type *payload_type,
                                void *output,
                                sinew_make_safe safe,
                                struct sinew_guard **guard);

/**
 * The same for messages that come over something else than an endpoint: hand each to `sinew_check_sealed`, and send what `sinew_guard_echo` says to the
 * sender. The name of the data ID is the one that counts, not that of the type. Needs no node. `*guard` is set after `SINEW_ERROR_SAFE_FAILS`, too.
 * Any thread.
 */
sinew_status sinew_guard_alone(const struct sinew_data_id *data_id,
                               const struct sinew_protected_type *payload_type,
                               void *output,
                               sinew_make_safe safe,
                               struct sinew_guard **guard);

/**
 * Has a guard take in a sealed message. `SINEW_OK`: it is good and the output is live; its payload begins at `SINEW_SEALED_HEAD` and is
 * `SINEW_SEALED_OVERHEAD` bytes shorter. `SINEW_NOTHING`: it is not to be used, since it is bad, or the output is safe. `*fault` is set in both
 * cases; `fault` may be NULL. Each message is taken once: the second time it is a repeated one. Any thread.
 */
sinew_status sinew_check_sealed(struct sinew_guard *guard,
                                const void *sealed,
                                size_t length,
                                sinew_sealed_fault *fault);

/**
 * The time that the sender is to quote as `echo_ns` of its next messages, on the clock of `sinew_now_ns`. Say it to the sender four times in
 * `age_max_ns`: the last eight count. For `sinew_guard_alone`; an endpoint does so itself. Any thread.
 */
sinew_status sinew_guard_echo(struct sinew_guard *guard,
                              uint64_t *at_ns);

/**
 * Makes the output live: from now on commands pass. Somebody has seen that it is safe to; nothing does this by itself, and a live output that has become
 * safe stays so until this is called again. `SINEW_ERROR_NOT_GOOD` until `good_min` good messages in a row have come, the last one in time;
 * `SINEW_ERROR_SAFE_FAILS` if it could not be made safe. Any thread.
 */
sinew_status sinew_arm(struct sinew_guard *guard);

/**
 * Calls `command` with the output and `argument` if the output is live, and keeps what makes it safe from doing so meanwhile. `SINEW_NOTHING`: it is safe, and
 * `command` was not called. `SINEW_ERROR_SAFE_FAILS`: the same, and what makes it safe has failed until now. `*state` says since what in all three cases;
 * `state` may be NULL. Blocks while another thread has the output in hand. Any thread.
 */
sinew_status sinew_apply(struct sinew_guard *guard,
                         sinew_command command,
                         void *argument,
                         sinew_output_state *state);

/**
 * Makes the output safe: at once or, while another thread has it in hand, as soon as that has not. Does not block, and may be called where a guard
 * calls the program, too. Any thread.
 */
sinew_status sinew_trip(struct sinew_guard *guard);

/**
 * Whether commands reach the output now and, if not, since what. `SINEW_ERROR_SAFE_FAILS`: they do not, but what makes it safe has failed until now, so
 * that it may move still; `*state` is set all the same. Any thread.
 */
sinew_status sinew_guard_state(struct sinew_guard *guard,
                               sinew_output_state *state);

/**
 * What the guard has counted since it was made. Any thread.
 */
sinew_status sinew_guard_tally(struct sinew_guard *guard, struct sinew_tally *tally);

/**
 * Makes the output safe and lets go of it: after `SINEW_OK` the library calls nothing of it any more, and `*guard` is NULL. After
 * `SINEW_ERROR_SAFE_FAILS` it goes on trying, and lets go as soon as the output is safe: the output must be there until then, which is when
 * another call says `SINEW_OK` or `SINEW_ERROR_NO_SUCH_GUARD`. What comes of its type to its endpoint goes on being refused. Blocks while another thread
 * has the output in hand. Any thread.
 */
sinew_status sinew_release(struct sinew_guard **guard);

/**
 * The same for where a guard calls the program, which may not wait: makes the output safe as `sinew_trip`, and lets go of it as soon as nobody has it in
 * hand any more and it is safe. `*guard` is NULL then, and no call knows it any more. Nobody says when the library calls nothing of it any more: `output`
 * and what makes it safe must be there until the end of the process. Does not block. Any thread.
 */
sinew_status sinew_release_later(struct sinew_guard **guard);

/**
 * A text for an output's state, one of `sinew_output_state`. Never NULL. Any thread.
 */
const char *sinew_output_state_text(int32_t state);

/**
 * A text for a status: what it means in general. Never NULL. Any thread.
 */
const char *sinew_status_text(int32_t status);

/**
 * A sentence about the last error of the calling thread: what was wrong this time, and what to do. Never NULL; empty if
 * there was no error. It stays until the thread's next error. Any thread, each of which has its own.
 */
const char *sinew_last_error(void);

/**
 * A text for an outcome. Never NULL. Any thread.
 */
const char *sinew_outcome_text(int32_t outcome);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

/** A text of a string literal. C only: in C++ take sinew.hpp, or sinew_text_of. */
#define SINEW_TEXT(literal) ((sinew_text){ "" literal, sizeof(literal) - 1 })

/** A text of a C string; of none if it is NULL. Any thread. */
static inline sinew_text sinew_text_of(const char *string)
{
    sinew_text text;
    text.bytes = string;
    text.length = string ? strlen(string) : 0;
    return text;
}

/* Tables of fields, for sinew_create_value and sinew_read_value. In C++ take SINEW_PAYLOAD and SINEW_STRUCT of sinew.hpp.
 *
 *   struct torque { double newton_metres; uint32_t number; float gains[3]; char mode[16]; };
 *   static const sinew_field torque_fields[] = {
 *       SINEW_FIELD(struct torque, newton_metres), SINEW_FIELD(struct torque, number),
 *       SINEW_FIELD(struct torque, gains), SINEW_FIELD(struct torque, mode) };
 *   static const sinew_payload_type torque_type = SINEW_PAYLOAD("knee.torque", SINEW_STREAM, struct torque, torque_fields);
 */
#ifndef __cplusplus

#define SINEW_MEMBER(type, member) (((type *)0)->member)
#define SINEW_INT_TYPE(is_signed, size) ((size) == 1 ? ((is_signed) ? SINEW_TYPE_I8 : SINEW_TYPE_U8) : (size) == 2 ? ((is_signed) ? SINEW_TYPE_I16 : SINEW_TYPE_U16) : (size) == 4 ? ((is_signed) ? SINEW_TYPE_I32 : SINEW_TYPE_U32) : ((is_signed) ? SINEW_TYPE_I64 : SINEW_TYPE_U64))
/* A type that is not in this list, a lone `char` or a pointer for one, is an error of the compiler. */
#define SINEW_TYPE_OF(value) _Generic((value), bool: SINEW_TYPE_BOOL, bool *: SINEW_TYPE_BOOL, float: SINEW_TYPE_F32, float *: SINEW_TYPE_F32, double: SINEW_TYPE_F64, double *: SINEW_TYPE_F64, char *: SINEW_TYPE_TEXT, signed char: SINEW_TYPE_I8, signed char *: SINEW_TYPE_I8, unsigned char: SINEW_TYPE_U8, unsigned char *: SINEW_TYPE_U8, short: SINEW_INT_TYPE(1, sizeof(short)), short *: SINEW_INT_TYPE(1, sizeof(short)), unsigned short: SINEW_INT_TYPE(0, sizeof(short)), unsigned short *: SINEW_INT_TYPE(0, sizeof(short)), int: SINEW_INT_TYPE(1, sizeof(int)), int *: SINEW_INT_TYPE(1, sizeof(int)), unsigned: SINEW_INT_TYPE(0, sizeof(int)), unsigned *: SINEW_INT_TYPE(0, sizeof(int)), long: SINEW_INT_TYPE(1, sizeof(long)), long *: SINEW_INT_TYPE(1, sizeof(long)), unsigned long: SINEW_INT_TYPE(0, sizeof(long)), unsigned long *: SINEW_INT_TYPE(0, sizeof(long)), long long: SINEW_TYPE_I64, long long *: SINEW_TYPE_I64, unsigned long long: SINEW_TYPE_U64, unsigned long long *: SINEW_TYPE_U64)
#define SINEW_ARRAY_OF(value) _Generic((value), bool *: SINEW_FIELD_ARRAY, float *: SINEW_FIELD_ARRAY, double *: SINEW_FIELD_ARRAY, signed char *: SINEW_FIELD_ARRAY, unsigned char *: SINEW_FIELD_ARRAY, short *: SINEW_FIELD_ARRAY, unsigned short *: SINEW_FIELD_ARRAY, int *: SINEW_FIELD_ARRAY, unsigned *: SINEW_FIELD_ARRAY, long *: SINEW_FIELD_ARRAY, unsigned long *: SINEW_FIELD_ARRAY, long long *: SINEW_FIELD_ARRAY, unsigned long long *: SINEW_FIELD_ARRAY, default: 0)
#define SINEW_FIELD_RAW(type, member, extra, layout, field_type, flags) { #member, offsetof(type, member), sizeof SINEW_MEMBER(type, member), extra, layout, field_type, flags }

/** A field that is a bool, a number, an array of these, or a text (an array of char that ends with a zero). */
#define SINEW_FIELD(type, member) SINEW_FIELD_RAW(type, member, 0, NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_ARRAY_OF(SINEW_MEMBER(type, member)))
/** An array of which the `size_t` member `count` says how many elements are in use. */
#define SINEW_FIELD_LIST(type, member, count) SINEW_FIELD_RAW(type, member, offsetof(type, count), NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_FIELD_ARRAY | SINEW_FIELD_COUNTED)
/** A field that has a value if the `bool` member `is_there` is true. */
#define SINEW_FIELD_MAYBE(type, member, is_there) SINEW_FIELD_RAW(type, member, offsetof(type, is_there), NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_FIELD_OPTIONAL | SINEW_ARRAY_OF(SINEW_MEMBER(type, member)))
/** An array of `uint8_t` that is written as bytes; the `size_t` member `count` says how many are in use. */
#define SINEW_FIELD_BYTES(type, member, count) SINEW_FIELD_RAW(type, member, offsetof(type, count), NULL, SINEW_TYPE_BYTES, SINEW_FIELD_COUNTED)
/** A field that is a struct with this `sinew_layout`. */
#define SINEW_FIELD_STRUCT(type, member, layout) SINEW_FIELD_RAW(type, member, 0, &(layout), SINEW_TYPE_STRUCT, 0)
/** An array of structs with this `sinew_layout`. */
#define SINEW_FIELD_STRUCTS(type, member, layout) SINEW_FIELD_RAW(type, member, 0, &(layout), SINEW_TYPE_STRUCT, SINEW_FIELD_ARRAY)
/** The table of a struct. */
#define SINEW_LAYOUT(type, fields) { fields, sizeof(fields) / sizeof(fields)[0], sizeof(type) }
/** A type of payloads: its name as a literal, its class, its struct, and the array of its fields. */
#define SINEW_PAYLOAD(name, message_class, type, fields) SINEW_PAYLOAD_EXPIRING(name, message_class, 0, type, fields)
/** The same with a time to live in nanoseconds: a message that is older expires where it waits. */
#define SINEW_PAYLOAD_EXPIRING(name, message_class, expires_after_ns, type, fields) { { "" name, sizeof(name) - 1 }, message_class, SINEW_LAYOUT(type, fields), expires_after_ns }

#endif

#endif /* SINEW_H */

#ifndef SINEW_H
#define SINEW_H

/*
 * Sinew: NodeAPI for C and C++. Generated from the source of bindings/c; do not edit.
 *
 * An application connects to the node of its host, gets a transport address (an endpoint), and sends and receives
 * messages on it. bindings/c/README.md has a first program; docs/book/src/reference/guarantees.md has the guarantees
 * for messages.
 *
 * Threads.  One thread at a time uses an endpoint: a call on it while another thread is in one returns
 *   SINEW_ERROR_BUSY and does nothing. Different endpoints are independent: use one for each thread. The documentation
 *   of each function says which threads may call it.
 *   "The endpoint's thread": the thread that has it now. To pass it on, order the last call of the old thread before the
 *   first of the new one (a mutex, a queue, pthread_join). "Any thread": any number, at any time. The sentence of
 *   sinew_last_error belongs to the calling thread.
 * Messages.  A message passed to a function that sends is gone when it returns, regardless of the result, and
 *   `*message` is all zeros. Exceptions: four errors are returned before the message is looked at, and leave it
 *   unchanged. After SINEW_ERROR_BUSY it is still yours. After SINEW_ERROR_NO_SUCH_ENDPOINT, _FORKED and _PANIC it
 *   cannot be sent any more, and goes with its endpoint. SINEW_ERROR_NO_SUCH_MESSAGE: it was gone before.
 *   A received message is yours until sinew_settle_message returns SINEW_OK, or its endpoint is unregistered.
 * Pointers.  NULL is rejected unless the function allows it. Any other pointer must point to its declared type during
 *   the call. Endpoints and messages are looked up, not dereferenced: one that was unregistered, sent, discarded or
 *   settled is rejected. The `bytes` of a message are valid until then, and not after. Between two calls any one thread
 *   may write or read them.
 * Out.  A result behind a pointer is set if the function returns SINEW_OK, and else left unchanged, unless the
 *   function says more.
 * Time.  All times are nanoseconds, as their names say; UINT64_MAX waits without limit.
 * Texts.  UTF-8 with a length. Texts returned by the library are terminated by a zero; do not free them.
 * Panics.  A fault of the library ends as SINEW_ERROR_PANIC and never leaves it. The endpoint on which it happened can
 *   only be unregistered; everything else keeps working.
 * fork.  A child of fork may not use its parent's endpoints: they return SINEW_ERROR_FORKED there. It may not write the
 *   bytes of its parent's messages either, which may be shared memory. It may register its own if it may call malloc,
 *   that is if the parent had one thread. The node detects the parent's end also while a child with its connections
 *   lives, and reports it to the peers of its direct links. Endpoints do not survive exec.
 * Protected.  For commands that move something. sinew_send_protected seals them. sinew_guard_output passes only good
 *   ones to an output, and makes it safe when they are bad or missing. Only sinew_arm makes it live. Bytes and rules are
 *   those of Rust (docs/protocol/protected.md).
 *   The functions that a guard calls may call only two functions of a guard, sinew_trip and sinew_release_later, and no
 *   sinew_receive_message of an endpoint with protected payloads (SINEW_ERROR_BUSY).
 *   A guard checks a payload's length, not whether you can read it: if you cannot, call sinew_trip. While making an
 *   output safe fails, it is not reported as safe (SINEW_ERROR_SAFE_FAILS). Release guards before their outputs, and
 *   before the end of main. A child of fork has none of its parent's guards. If the parent had guards, or tried to
 *   create one, the child can create none (SINEW_ERROR_FORKED): its outputs are not made safe there.
 * Log.  Events without a status (a link that was not created, no shared memory) are lines on the standard error,
 *   warnings and errors only. The environment variable SINEW_LOG changes the level: off, error, warn, info, debug; it is
 *   read at the first registration or guard.
 * Sizes.  sinew_options carries its size and may grow; all other structs and all numbers stay unchanged as long as
 *   SINEW_ABI does.
 */


#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/**
 * The version of this header's structs and functions. It grows when programs must be recompiled, counted
 * from the release 0.1.0 on.
 */
#define SINEW_ABI 1

/**
 * Bytes that the text of any TID needs, its zero included: `255.255.255.255/ffffffff`.
 */
#define SINEW_TID_TEXT 32

/**
 * Maximum number of members of one message to many that have an outcome.
 */
#define SINEW_MEMBERS_MAX 4096

/**
 * For `flags` of `sinew_field`: the field is an array. Without `SINEW_FIELD_COUNTED` all of its elements are
 * written and required.
 */
#define SINEW_FIELD_ARRAY 1

/**
 * For `flags` of `sinew_field`: a `size_t` at `extra_offset` is the number of elements in use. Without it
 * all elements of the array are in use.
 */
#define SINEW_FIELD_COUNTED 2

/**
 * For `flags` of `sinew_field`: a `bool` at `extra_offset` says whether the field has a value. Without one
 * it is written as `null`; when read it may also be missing. Rust's `Option`.
 */
#define SINEW_FIELD_OPTIONAL 4

/**
 * For `flags` of `sinew_barrier`: does not wait for the return of a party that is listed by its name and has
 * failed, was stopped, or is on a lost node. Then `sinew_meet` returns `SINEW_ERROR_PARTY_LOST`.
 */
#define SINEW_FAIL_ON_LOSS 1

/**
 * For `flags` of `sinew_barrier`: a phase. A party that has reached it counts until it is unregistered, also
 * while it does something else: an application that is restarted continues at once if the other parties have
 * arrived.
 */
#define SINEW_PHASE 2

/**
 * For the times of `sinew_stop_node`: there is none.
 */
#define SINEW_STOP_NO_TIME UINT64_MAX

/**
 * Bytes of a node's name in `sinew_stop_node`, with its zero.
 */
#define SINEW_STOP_NAME 64

/**
 * For `events` of `sinew_options`: `sinew.node_event`, nodes that are found, lost, restarted.
 */
#define SINEW_NODE_EVENTS 1

/**
 * For `events` of `sinew_options`: `sinew.requirement_event`, requirements that are lost or met again.
 */
#define SINEW_REQUIREMENT_EVENTS 2

/**
 * For `links` of `sinew_options`: through the unix socket only, no shared memory.
 */
#define SINEW_SOCKET_ONLY 1

/**
 * For `links` of `sinew_options`: direct links with other processes that also have them. The endpoint accepts
 * links, and requests one to each peer with frequent messages: at the 8th message within one second. Of
 * `SINEW_DIRECT_AUTOMATIC`, `SINEW_DIRECT_ALWAYS` and `SINEW_DIRECT_NEVER` set one at most.
 */
#define SINEW_DIRECT_AUTOMATIC 16

/**
 * For `links` of `sinew_options`: direct links with other processes that also have them. The endpoint accepts
 * links, and requests one at the first message to a peer.
 */
#define SINEW_DIRECT_ALWAYS 2

/**
 * For `links` of `sinew_options`: all messages go through the node.
 */
#define SINEW_DIRECT_NEVER 32

/**
 * For `links` of `sinew_options`: `spin_ns` is the maximum spin time. The endpoint spins about twice as long
 * as messages lately took to arrive, and not at all while they take longer than `spin_ns`. Without `spin_ns`
 * this does nothing.
 */
#define SINEW_SPIN_ADAPTIVE 4

/**
 * For `links` of `sinew_options`: does not register again when the connection to the node has ended. Then
 * every call returns `SINEW_ERROR_CLOSED`. Without this the endpoint reconnects by itself.
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
 * The result of a call. Negative: an error, and `sinew_last_error` has a sentence about it.
 */
enum sinew_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Success.
     */
    SINEW_OK = 0,
    /**
     * No error, but no result: no message arrived in time, or no application has the name.
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
     * The node rejected the registration, or a wait at a barrier; the sentence says why. Nothing is
     * registered.
     */
    SINEW_ERROR_REFUSED = -3,
    /**
     * A requirement was not ready at the deadline. Nothing is registered.
     */
    SINEW_ERROR_WAITING = -4,
    /**
     * The node did not answer in time. Whether it executed the request is not known.
     */
    SINEW_ERROR_NO_ANSWER = -5,
    /**
     * The connection to the node has ended, and the registration with it: unregister, then register again.
     */
    SINEW_ERROR_CLOSED = -6,
    /**
     * There was no room in time: the node or, on a direct link, the receiver is stopped or too slow. Nothing
     * of the message is received; it may be created and sent again.
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
     * The message requests no reply. Nothing was sent.
     */
    SINEW_ERROR_NOT_ASKED = -11,
    /**
     * The received bytes are not a value of their kind.
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
     * Too many endpoints in this process, or too many unsettled messages. Nothing was sent or registered.
     */
    SINEW_ERROR_TOO_MANY = -16,
    /**
     * The endpoint belongs to the process that this one was forked from. Nothing was done.
     */
    SINEW_ERROR_FORKED = -17,
    /**
     * A fault of this library. The endpoint can only be unregistered; all others keep working.
     */
    SINEW_ERROR_PANIC = -18,
    /**
     * A message is on loan, neither sent nor discarded: the endpoint sends nothing else before. Nothing was
     * sent.
     */
    SINEW_ERROR_LOAN_ACTIVE = -19,
    /**
     * The connection to the node has ended, through no fault of this endpoint, which registers again by
     * itself while it is used: continue. Each send without a time limit tries, and `sinew_receive_message`,
     * which returns this once, waits for it. The message was not sent.
     */
    SINEW_ERROR_DISCONNECTED = -20,
    /**
     * Not all parties arrived at the barrier in time. The sentence says which are missing; the others keep
     * waiting.
     */
    SINEW_ERROR_NOT_MET = -21,
    /**
     * A party of the barrier was lost, and the flags say not to wait for it. The sentence says which.
     */
    SINEW_ERROR_PARTY_LOST = -22,
    /**
     * This is no guard: it is NULL, or was released, or never created. Nothing was done.
     */
    SINEW_ERROR_NO_SUCH_GUARD = -23,
    /**
     * Too few good messages in a row have arrived, or the last one too long ago: the output cannot be armed
     * yet. It stays safe.
     */
    SINEW_ERROR_NOT_GOOD = -24,
    /**
     * `sinew_make_safe` reports failure: whether the output is safe is not known. It is called again each
     * millisecond, until it succeeds.
     */
    SINEW_ERROR_SAFE_FAILS = -25,
    /**
     * The threads that make outputs safe in time cannot be started, or are not more urgent than the calling
     * thread. No guard was created.
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
 * The outcome of a message.
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
     * The destination failed, or ended before it settled the message.
     */
    SINEW_FAILED = 2,
    /**
     * The connection to its node was lost before it was sent: it was not handled.
     */
    SINEW_PEER_LOST = 3,
    /**
     * Not known.
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
     * Not handled: the payload is not a value of its kind.
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
     * Not handled: the source is not the sender's own address.
     */
    SINEW_REJECTED_FORGED_SOURCE = 23,
    /**
     * Not handled: the handler refused it.
     */
    SINEW_REJECTED_BY_HANDLER = 24,
    /**
     * Not handled: the destination does not support this request.
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
     * Not handled: a confirmed message to many has too many members or nodes, or too many such messages are
     * in flight.
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
 * Whether commands reach an output and, if not, the cause.
 */
enum sinew_output_state
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Commands reach the output.
     */
    SINEW_LIVE = 0,
    /**
     * It was never armed.
     */
    SINEW_SAFE_NOT_ARMED = 1,
    /**
     * No good message arrived in time.
     */
    SINEW_SAFE_SILENT = 2,
    /**
     * More consecutive messages are missing than `lost_max`.
     */
    SINEW_SAFE_TOO_MUCH_LOST = 3,
    /**
     * More bad messages arrived than `bad_max`.
     */
    SINEW_SAFE_TOO_MANY_BAD = 4,
    /**
     * The sender counts from a new start: it was restarted.
     */
    SINEW_SAFE_RESTARTED = 5,
    /**
     * The receiver's host was suspended: the age of the commands that arrived meanwhile is not known.
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
 * The fault of a protected message.
 */
enum sinew_sealed_fault
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * None.
     */
    SINEW_FAULT_NONE = 0,
    /**
     * Its bytes are not those that this sender sealed for this receiver: damaged, inserted, or meant for
     * another receiver.
     */
    SINEW_FAULT_CORRUPT = 1,
    /**
     * It quotes no time of this receiver, or one that is too long ago.
     */
    SINEW_FAULT_TOO_OLD = 2,
    /**
     * It has arrived before.
     */
    SINEW_FAULT_REPEATED = 3,
    /**
     * A message that was sent later has arrived before it.
     */
    SINEW_FAULT_BACKWARDS = 4,
    /**
     * Its sender was restarted: its incarnation is not that of the last message.
     */
    SINEW_FAULT_RESTARTED = 5,
    /**
     * Too many messages before it are missing.
     */
    SINEW_FAULT_GAP = 6,
    /**
     * The seal is valid, but the payload does not have the length of the type.
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
 * The urgency of a message, and the effect of a newer message on an older one.
 */
enum sinew_message_class
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Delivered in order, ahead of all other classes.
     */
    SINEW_CONTROL = 0,
    /**
     * Only the newest value of each source and kind: a late setpoint is a hazard. Cannot be confirmed.
     */
    SINEW_STREAM = 1,
    /**
     * Delivered in order, after the other classes.
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
 * The type of a field, or of the elements of an array. In C, `SINEW_FIELD` finds it by itself.
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
 * Whether a node is stopped.
 */
enum sinew_stop_state
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Nothing was received from the node.
     */
    SINEW_STOP_UNKNOWN = 0,
    /**
     * Outputs may be armed.
     */
    SINEW_STOP_RELEASED = 1,
    /**
     * No press is known. Outputs stay as they are and cannot be armed: the node does not know yet whether
     * the others are stopped.
     */
    SINEW_STOP_HELD = 2,
    /**
     * A stop is in force.
     */
    SINEW_STOP_STOPPED = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum sinew_stop_state sinew_stop_state;
#else
typedef int32_t sinew_stop_state;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * An endpoint: a transport address of this process. Programs have only pointers to it.
 */
typedef struct sinew_endpoint sinew_endpoint;

/**
 * The only access to an output. Programs have only pointers to it.
 */
typedef struct sinew_guard sinew_guard;

/**
 * A text: UTF-8, not terminated by a zero. `SINEW_TEXT("...")` makes one of a literal, `sinew_text_of` of a
 * C string.
 */
typedef struct sinew_text {
    /**
     * The first byte; may be NULL if the length is 0.
     */
    const char *bytes;
    /**
     * Length in bytes, without a zero at its end.
     */
    size_t length;
} sinew_text;

/**
 * Options of a registration. Set the whole struct to zero, then `size`, then the fields that you need; zero
 * means the default everywhere. The struct grows at its end only: a program compiled with a shorter one
 * works as before.
 */
typedef struct sinew_options {
    /**
     * `sizeof(sinew_options)`: tells the library the version that the program was compiled with.
     */
    size_t size;
    /**
     * The name, 1 to 63 bytes without control characters, unique on the node. Default: none.
     */
    struct sinew_text name;
    /**
     * Requirements that must be met, on this node or any, before this application is ready: `knee.drive`,
     * `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `knee.drive at homed`, `camera ?2s`. At most 64.
     * Default: none.
     */
    const struct sinew_text *required;
    /**
     * Number of requirements.
     */
    size_t required_count;
    /**
     * Names of the payload types that the application sends or handles, so that a hash collision of two of
     * them is found at registration. At most 64. Default: none.
     */
    const struct sinew_text *handled;
    /**
     * Number of names.
     */
    size_t handled_count;
    /**
     * A fixed address, `0x1000` to `0x7fffffff`. Default: a dynamic one.
     */
    uint32_t fixed_address;
    /**
     * The events of the node's layers to receive: `SINEW_NODE_EVENTS`, `SINEW_REQUIREMENT_EVENTS`. Default:
     * none.
     */
    uint32_t events;
    /**
     * Time limit of the registration, waiting for the requirements included. Default: 60 s.
     */
    uint64_t deadline_ns;
    /**
     * Stall timeout: how long a send waits while the node or, on a direct link, the receiver accepts
     * nothing; any progress restarts that time. Default: 1 s. For the total time of one send:
     * `sinew_room_within`.
     */
    uint64_t stall_timeout_ns;
    /**
     * Received messages that wait in this process before the library stops reading from the socket or the
     * rings; more while a call waits for an answer. Default: 256.
     */
    size_t inbox_capacity;
    /**
     * Spin time: how long a thread that waits at a ring polls it before it sleeps. At a socket
     * (`SINEW_SOCKET_ONLY`) it never spins. Spinning keeps a CPU busy and saves the wake-up, which is most
     * of a short message's latency: for a thread with a CPU of its own. Default: it sleeps at once.
     */
    uint64_t spin_ns;
    /**
     * The transport of the messages: `SINEW_SOCKET_ONLY`, `SINEW_DIRECT_AUTOMATIC`, `SINEW_DIRECT_ALWAYS`,
     * `SINEW_DIRECT_NEVER`, `SINEW_SPIN_ADAPTIVE`, `SINEW_WITHOUT_RECONNECT`. Default: shared memory if the
     * system has it, `SINEW_DIRECT_AUTOMATIC`, and a reconnect when the connection has ended.
     */
    uint32_t links;
    /**
     * Zero.
     */
    uint32_t reserved;
    /**
     * Size in bytes of this side's ring of each direct link, from 4 KiB to 1 MiB (other values are clamped). It
     * is rounded up to a power of two, and never more than the node's `lncl.ring_bytes`. A message longer than
     * half of it is sent in pieces. All rings for direct links that a process creates take at most 64 MiB.
     * Default: 64 KiB.
     */
    size_t direct_ring_bytes;
} sinew_options;

/**
 * A transport ID (TID): the node's address in the upper half, the application's in the lower. 0 is no
 * application.
 */
typedef uint64_t sinew_tid;

/**
 * Type of a payload: see `sinew_kind_named`. No type has 0.
 */
typedef uint32_t sinew_kind;

/**
 * A message under construction. `bytes` is writable until it is sent or discarded; do not change the other
 * fields.
 */
typedef struct sinew_message {
    /**
     * The payload, all zeros at first.
     */
    uint8_t *bytes;
    /**
     * Length of the payload in bytes.
     */
    size_t length;
    /**
     * For the library: identifies the message.
     */
    uint64_t token;
} sinew_message;

/**
 * The outcome of a message to many at one of its members.
 */
typedef struct sinew_member_outcome {
    /**
     * The member. If a node has not named its members: its node, and the application address that the
     * message was sent to.
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
 * A received message. `bytes` is readable until it is settled; do not change the fields.
 */
typedef struct sinew_received {
    /**
     * The payload.
     */
    const uint8_t *bytes;
    /**
     * Length of the payload in bytes.
     */
    size_t length;
    /**
     * The sender; the sender's node vouches for it.
     */
    sinew_tid source;
    /**
     * The destination: this endpoint, a group, or all applications.
     */
    sinew_tid destination;
    /**
     * The number of the message among the source's messages, from 1.
     */
    uint64_t sequence;
    /**
     * Time of sending, on the clock of `sinew_now_ns`, with an error of up to `sent_error_ns`. Valid only if
     * `is_sent_known`. For an age use `sinew_age`, `sinew_age_at_most` or `sinew_is_older_than`.
     */
    uint64_t sent_ns;
    /**
     * Maximum error of `sent_ns`, if `is_sent_known`: 0 for a message of this host. It grows while the clock
     * of the sender's host is not measured.
     */
    uint64_t sent_error_ns;
    /**
     * For the library: identifies the message.
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
     * Whether `sent_ns` is known. It is not while the clock of the sender's host is not measured, or may be
     * wrong by more than 32 s.
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
     * Destination; 0, which no application has: several that are no longer distinguished.
     */
    sinew_tid destination;
    /**
     * Number of messages since the last report. Never 0.
     */
    uint64_t count;
    /**
     * Time of the first rejection, on the clock of `sinew_now_ns`.
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
     * Reason: one of `sinew_outcome`. `SINEW_REJECTED_UNKNOWN_KIND`: the destination does not handle this
     * type.
     */
    int32_t outcome;
    /**
     * Type of the payload; 0, which no type has: several, or not known.
     */
    sinew_kind kind;
    /**
     * One of `sinew_message_class`, of the first message; -1, which is none of them: not known.
     */
    int32_t message_class;
    /**
     * Name of the destination, at most 63 bytes, terminated by a zero; empty if it is not known.
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
 * A field of a struct. C: one of the macros `SINEW_FIELD`, `SINEW_FIELD_LIST`, `SINEW_FIELD_MAYBE`,
 * `SINEW_FIELD_STRUCT`, `SINEW_FIELD_STRUCTS`, `SINEW_FIELD_BYTES`. C++: `SINEW_PAYLOAD` and `SINEW_STRUCT`
 * of sinew.hpp write the whole table.
 */
typedef struct sinew_field {
    /**
     * The name in the payload, a C string.
     */
    const char *name;
    /**
     * Offset in the struct, in bytes.
     */
    size_t offset;
    /**
     * Length in bytes, with all elements of an array.
     */
    size_t size;
    /**
     * Offset of its count or its `bool`: see `flags`.
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
 * The table of a struct's fields. C: `SINEW_LAYOUT`; `SINEW_LAYOUT_EMPTY` for a struct without fields.
 */
typedef struct sinew_layout {
    /**
     * The fields, at most 64; may be NULL if there are none.
     */
    const struct sinew_field *fields;
    /**
     * Number of fields; 0 for a type without fields.
     */
    size_t fields_count;
    /**
     * Length of the struct in bytes.
     */
    size_t size;
} sinew_layout;

/**
 * A payload type: its name, its class, its fields, and its time to live. C: `SINEW_PAYLOAD`,
 * `SINEW_PAYLOAD_EXPIRING`; `SINEW_PAYLOAD_EMPTY`, `SINEW_PAYLOAD_EMPTY_EXPIRING` for a type without fields.
 */
typedef struct sinew_payload_type {
    /**
     * The name, the same in every program and language.
     */
    struct sinew_text name;
    /**
     * One of `sinew_message_class`.
     */
    int32_t message_class;
    /**
     * The fields.
     */
    struct sinew_layout layout;
    /**
     * Time to live: an older message expires in its queue, and is not received. 0: it never expires. At most
     * 71 minutes and 35 s: more counts as that.
     */
    uint64_t expires_after_ns;
} sinew_payload_type;

/**
 * A barrier: a point where several applications, on any nodes, wait for each other. It need not be created,
 * and can be used again and again. Set the whole struct to zero, then the fields that you need. All parties
 * give the same name and the same list of parties.
 */
typedef struct sinew_barrier {
    /**
     * The name, 1 to 63 bytes; of a phase one word.
     */
    struct sinew_text name;
    /**
     * The parties that have to arrive: `knee.drive`, `*.drive`, `hip.imu | knee.imu`, `2 of *.drive`, `3 of
     * *`. At most 64. The endpoint that waits must be one of them.
     */
    const struct sinew_text *parties;
    /**
     * Number of parties.
     */
    size_t parties_count;
    /**
     * Longest wait, rounded up to milliseconds. Default: 60 s.
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
 * One node's part in the stop.
 */
typedef struct sinew_stop_node {
    /**
     * The address of its stop, which has the node.
     */
    sinew_tid tid;
    /**
     * Time from the newest press until the confirmation was there; `SINEW_STOP_NO_TIME`: the node has not
     * confirmed, and may still move.
     */
    uint64_t confirmed_ns;
    /**
     * Time after the press within which the node's own watchdogs make its outputs safe although it has not
     * confirmed; `SINEW_STOP_NO_TIME`: no such time is known.
     */
    uint64_t bound_ns;
    /**
     * One of `sinew_stop_state`.
     */
    int32_t state;
    /**
     * Number of guarded outputs in its process.
     */
    uint32_t outputs;
    /**
     * Its name, of which the first bytes are kept, terminated by a zero.
     */
    char name[SINEW_STOP_NAME];
} sinew_stop_node;

/**
 * The state of the stop, as the endpoint's node knows it.
 */
typedef struct sinew_stop_report {
    /**
     * Number of nodes, the endpoint's own first; may be above the capacity that was given.
     */
    size_t nodes;
    /**
     * Number of presses that are not released.
     */
    size_t presses;
    /**
     * State of the endpoint's node: one of `sinew_stop_state`.
     */
    int32_t state;
    /**
     * Whether the system is stopped and every known node has confirmed that its outputs are safe.
     */
    bool is_confirmed;
    /**
     * Zeros.
     */
    uint8_t reserved[3];
} sinew_stop_report;

/**
 * A type of protected payloads: its name, and the limits of the receiver. Both ends use the same one, best
 * from a shared header; in Rust it is `Payload::NAME` and `Payload::PROTECTION`. `sinew_protected_type_of`
 * fills all of it.
 */
typedef struct sinew_protected_type {
    /**
     * The name, at least 1 byte.
     */
    struct sinew_text name;
    /**
     * Length of each payload in bytes, `sizeof` of a plain struct: a payload of another length is not sent,
     * and counts as bad when it arrives. 0: any length. A guard checks nothing else of a payload: if you
     * cannot read one that came through, call `sinew_trip`, or such payloads keep the output live forever.
     */
    size_t length;
    /**
     * Maximum time between two good messages, above 0; after it the output is made safe.
     */
    uint64_t within_ns;
    /**
     * Maximum age of a message, at least 4 ns: from an echo that the receiver has sent to the arrival of the
     * message that quotes it.
     */
    uint64_t age_max_ns;
    /**
     * Maximum number of consecutive missing messages.
     */
    uint64_t lost_max;
    /**
     * Maximum number of bad messages among the last 64; none of them is used.
     */
    uint32_t bad_max;
    /**
     * Number of consecutive good messages before the output may be armed, at least 1.
     */
    uint32_t good_min;
    /**
     * One of `sinew_message_class`, for the sender. With `SINEW_STREAM` only the newest one may arrive: the
     * messages that it replaces count as missing.
     */
    int32_t message_class;
    /**
     * Zero.
     */
    uint32_t reserved;
} sinew_protected_type;

/**
 * Identifies a flow of protected messages at both of its ends. It is not sent: any other receiver computes
 * another checksum.
 */
typedef struct sinew_data_id {
    /**
     * The sender: its whole TID, the node's address included.
     */
    sinew_tid source;
    /**
     * The receiver, in the same form; one application.
     */
    sinew_tid destination;
    /**
     * Name of the payload's type.
     */
    struct sinew_text name;
} sinew_data_id;

/**
 * The sender's data in one protected message.
 */
typedef struct sinew_stamp {
    /**
     * Counts the messages of the flow, from 1.
     */
    uint64_t counter;
    /**
     * The sender's incarnation, never the same one twice. `sinew_now_ns` at its start is sufficient.
     */
    uint64_t incarnation;
    /**
     * The newest time that the sender has received from the receiver (`sinew_guard_echo`); 0 for none.
     */
    uint64_t echo_ns;
} sinew_stamp;

/**
 * Makes an output safe and returns 0. Any other result means failure; then it is called again each
 * millisecond. Any thread calls it, mostly one of the library's own: it must be short and must not wait, as
 * the outputs of all guards wait for it. It must return normally, by no exception and no `longjmp`. Of the
 * functions of a guard it may call only `sinew_trip` and `sinew_release_later`. It must not call
 * `sinew_receive_message` of an endpoint that sends or receives protected payloads: `SINEW_ERROR_BUSY`.
 */
typedef int32_t (*sinew_make_safe)(void *output, sinew_output_state why);

/**
 * Moves an output that is live; `sinew_make_safe` waits meanwhile. It must return as `sinew_make_safe` does,
 * and soon, and may call no other functions than that.
 */
typedef void (*sinew_command)(void *output, void *argument);

/**
 * The counts of a guard.
 */
typedef struct sinew_tally {
    /**
     * Good messages.
     */
    uint64_t good;
    /**
     * Messages with `SINEW_FAULT_CORRUPT`.
     */
    uint64_t corrupt;
    /**
     * Messages with `SINEW_FAULT_TOO_OLD`.
     */
    uint64_t too_old;
    /**
     * Messages with `SINEW_FAULT_REPEATED`.
     */
    uint64_t repeated;
    /**
     * Messages with `SINEW_FAULT_BACKWARDS`.
     */
    uint64_t backwards;
    /**
     * Messages with `SINEW_FAULT_RESTARTED`.
     */
    uint64_t restarted;
    /**
     * Messages with `SINEW_FAULT_GAP`.
     */
    uint64_t gaps;
    /**
     * Messages with `SINEW_FAULT_UNREADABLE`.
     */
    uint64_t unreadable;
    /**
     * Missing messages, by their counters.
     */
    uint64_t lost;
    /**
     * Number of times that the output went from live to safe.
     */
    uint64_t trips;
} sinew_tally;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Gives the `SINEW_ABI` that the library was built with. Any thread.
 *
 * A program that is compiled with this header need not compare: its registration is rejected if the two
 * differ. A program that loads the functions by their names, or registers no endpoint, has to compare by
 * itself.
 */
uint32_t sinew_abi(void);

/**
 * Connects to the node with `lncl.socket` = `socket` in its configuration, requests a transport address, and
 * waits until all requirements are ready (the paper's RegisterTransportAddress). `options` may be NULL: a
 * dynamic address, no name. Any thread, any number at the same time. Blocks at most until the deadline of
 * the options.
 *
 * One thread at a time may use the endpoint. A process may have 256, if its node allows it:
 * `lncl.clients_per_process_max`, 64.
 */
sinew_status sinew_register_transport_address(struct sinew_text socket,
                                              const struct sinew_options *options,
                                              struct sinew_endpoint **endpoint);

/**
 * Registers as `sinew_register_transport_address` does, for a program that was compiled with the header of
 * this `abi`. That function is a macro in C and C++, which calls this one with `SINEW_ABI`.
 * `SINEW_ERROR_INVALID_ARGUMENT` if the library has another: the shared structs may differ, and none of them
 * was read. Any thread. Blocks as that does.
 */
sinew_status sinew_register_with_abi(uint32_t abi,
                                     struct sinew_text socket,
                                     const struct sinew_options *options,
                                     struct sinew_endpoint **endpoint);

/**
 * Unregisters the address, and waits at most 2 s until the node has released it: then the name is free. The
 * endpoint is gone and `*endpoint` is NULL with every result except `SINEW_ERROR_BUSY` and
 * `SINEW_ERROR_FORKED`. Received messages that were not settled end as Failed; a message that was created
 * and not sent is discarded; the memory of both is freed. The endpoint's thread, or any other one while no
 * call on it is running.
 */
sinew_status sinew_unregister(struct sinew_endpoint **endpoint);

/**
 * Gives the address that was registered; 0 if this is no endpoint or another thread is in a call on it. The
 * endpoint's thread.
 */
sinew_tid sinew_endpoint_tid(const struct sinew_endpoint *endpoint);

/**
 * Gives the length of the longest payload that the node accepts, in bytes; 0 if this is no endpoint or
 * another thread is in a call on it. The endpoint's thread.
 */
size_t sinew_payload_max(const struct sinew_endpoint *endpoint);

/**
 * Gives the name of the node, terminated by a zero and valid until the endpoint is unregistered; NULL if
 * this is no endpoint or another thread is in a call on it. The endpoint's thread; the text may be read by
 * any.
 */
const char *sinew_node_name(const struct sinew_endpoint *endpoint);

/**
 * Resolves `name` to the application that has it now, on any node; waits at most for `within_ns`.
 * `SINEW_NOTHING` and a `*tid` of 0 if no application has it. The endpoint's thread.
 */
sinew_status sinew_resolve(struct sinew_endpoint *endpoint,
                           struct sinew_text name,
                           uint64_t within_ns,
                           sinew_tid *tid);

/**
 * Joins a group: messages to `sinew_group` of this name reach this endpoint from now on. Waits at most 2 s.
 * The endpoint's thread.
 */
sinew_status sinew_join_group(struct sinew_endpoint *endpoint, struct sinew_text name);

/**
 * Leaves a group. Waits at most 2 s. The endpoint's thread.
 */
sinew_status sinew_leave_group(struct sinew_endpoint *endpoint, struct sinew_text name);

/**
 * The address of the group called `name`, for its members on every node; 0 if `name` is no text. Any thread.
 */
sinew_tid sinew_group(struct sinew_text name);

/**
 * The kind of the payload type called `name`, the same in every program and language; 0, which no type has,
 * if `name` is no text. Any thread.
 */
sinew_kind sinew_kind_named(struct sinew_text name);

/**
 * Parses a TID from `text`, as in `10.0.0.7/1001`. Any thread.
 */
sinew_status sinew_tid_parse(struct sinew_text text, sinew_tid *tid);

/**
 * Writes a TID as text, terminated by a zero, into `capacity` bytes; `SINEW_TID_TEXT` are always enough. Any
 * thread.
 */
sinew_status sinew_tid_text(sinew_tid tid, char *text, size_t capacity);

/**
 * The current time in nanoseconds of the host's monotonic clock: the clock of `sent_ns`. Any thread.
 */
uint64_t sinew_now_ns(void);

/**
 * Loans `length` writable bytes, all zeros, for a payload of `kind` to `destination` (the paper's
 * CreateMessage). `message_class` is one of `sinew_message_class`. Does not block. The endpoint's thread;
 * the bytes, any.
 *
 * An endpoint loans one message at a time, and until that is sent or discarded it sends nothing else. Calls
 * that create another message, send, ask, reply, resolve, join or leave return `SINEW_ERROR_LOAN_ACTIVE`,
 * over every transport; outcomes of `sinew_settle_message` may wait. So fill it at once. The bytes are in
 * the shared memory from which the receiver reads them, if there is room: then sending copies nothing. Else
 * they are ordinary memory. If the process is killed during a loan, other processes notice only its end.
 */
sinew_status sinew_create_message(struct sinew_endpoint *endpoint,
                                  sinew_tid destination,
                                  sinew_kind kind,
                                  int32_t message_class,
                                  size_t length,
                                  struct sinew_message *message);

/**
 * Discards a message instead of sending it. `*message` is all zeros then. Does not block. The endpoint's
 * thread.
 */
sinew_status sinew_discard_message(struct sinew_endpoint *endpoint, struct sinew_message *message);

/**
 * Sets the time to live of a message under construction, in place of its type's: it expires in a queue when
 * it is older than `time_ns`. An unconfirmed message without one never expires; a confirmed one and a
 * request live only as long as their sender waits. At most 71 minutes and 35 s: more counts as that. 0 is
 * `SINEW_ERROR_INVALID_ARGUMENT`. Does not block. The endpoint's thread.
 */
sinew_status sinew_expires_after(struct sinew_endpoint *endpoint,
                                 const struct sinew_message *message,
                                 uint64_t time_ns);

/**
 * Sets the longest time that the sending of a message under construction waits for room, in place of the
 * `stall_timeout_ns` of the options; with 0 it does not wait at all. For a control loop:
 * `SINEW_ERROR_STALLED` says that there was no room in time and that nothing of the message is received. A
 * message that is longer than the ring needs a time in which its receiver reads a part of it. With
 * `SINEW_SOCKET_ONLY` such a message counts as sent with its first byte, and later calls send the rest. A
 * send with such a time does not look for a node that has gone (`SINEW_ERROR_DISCONNECTED`):
 * `sinew_receive_message`, or a send without such a time, does. Does not block. The endpoint's thread.
 */
sinew_status sinew_room_within(struct sinew_endpoint *endpoint,
                               const struct sinew_message *message,
                               uint64_t within_ns);

/**
 * Sends a message (the paper's SendMessage), without reporting its outcome. The message is gone when this
 * returns, sent or not: see Messages at the top. Blocks while there is no room and the receiver reads
 * nothing, for the `stall_timeout_ns` of the options, or as `sinew_room_within` says. The endpoint's thread.
 */
sinew_status sinew_send_message(struct sinew_endpoint *endpoint, struct sinew_message *message);

/**
 * Loans, copies and sends in one call. `bytes` may be NULL if `length` is 0. Blocks as `sinew_send_message`.
 * The endpoint's thread.
 */
sinew_status sinew_send_bytes(struct sinew_endpoint *endpoint,
                              sinew_tid destination,
                              sinew_kind kind,
                              int32_t message_class,
                              const void *bytes,
                              size_t length);

/**
 * Sends a message and waits for its outcome; `SINEW_UNKNOWN` if none arrived after `within_ns`. The message
 * expires in a queue when it is older. `*outcome` is set if this returns `SINEW_OK`. The message is gone as
 * with `sinew_send_message`. Messages that arrive meanwhile wait to be received. Blocks at most for
 * `within_ns`, the wait for room included; a longer one counts as the longest time to live of a message, 71
 * minutes and 35 s. With less than 20 ms this does not look for a node that has gone
 * (`SINEW_ERROR_DISCONNECTED`): `sinew_receive_message` does. The endpoint's thread.
 */
sinew_status sinew_send_message_confirmed(struct sinew_endpoint *endpoint,
                                          struct sinew_message *message,
                                          uint64_t within_ns,
                                          sinew_outcome *outcome);

/**
 * Sends a message to a group, to every application or to an address on all nodes, and waits for its outcome
 * at each member except this endpoint. Members are those that are known when the message arrives at their
 * node. Returns as soon as the last one is settled, and at the latest after `within_ns`: a member without an
 * outcome by then has `SINEW_UNKNOWN`. The first `capacity` outcomes, in the order of the TIDs, are written
 * to `members`, which may be NULL if that is 0. `*count` is the number of all, at most `SINEW_MEMBERS_MAX`,
 * and 0 for a group without members. Both are set if this returns `SINEW_OK`. `SINEW_ERROR_NOT_HANDLED`: no
 * member has a copy. All else is as with `sinew_send_message_confirmed`. The endpoint's thread.
 */
sinew_status sinew_send_message_confirmed_by_each(struct sinew_endpoint *endpoint,
                                                  struct sinew_message *message,
                                                  uint64_t within_ns,
                                                  struct sinew_member_outcome *members,
                                                  size_t capacity,
                                                  size_t *count);

/**
 * Sends a message as a request, in class Control, and waits for the reply, at most for `within_ns`, the wait
 * for room included. `*reply` is set if this returns `SINEW_OK`; settle it when it has been read. If it
 * returns `SINEW_ERROR_NOT_HANDLED` and `outcome` is not NULL, `*outcome` is the outcome of the request.
 * With 1024 unsettled messages there is no room for a reply: `SINEW_ERROR_TOO_MANY`, and nothing was sent.
 * The message is gone as with `sinew_send_message`. A longer `within_ns` counts as the longest time to live
 * of a message, 71 minutes and 35 s; with less than 20 ms this does not look for a node that has gone, as
 * with `sinew_send_message_confirmed`. The endpoint's thread.
 */
sinew_status sinew_ask(struct sinew_endpoint *endpoint,
                       struct sinew_message *message,
                       uint64_t within_ns,
                       struct sinew_received *reply,
                       sinew_outcome *outcome);

/**
 * Sends a message as the reply to an unsettled request; it goes to the requester, even if it was created for
 * another destination. The request still has to be settled. The message is gone as with
 * `sinew_send_message`, and this blocks as that does. The endpoint's thread.
 */
sinew_status sinew_reply(struct sinew_endpoint *endpoint,
                         const struct sinew_received *request,
                         struct sinew_message *message);

/**
 * Waits for a message, at most for `within_ns`; `SINEW_NOTHING` if none arrived (the paper's
 * ReceiveMessage). The order is Control, then Stream (only the newest value of each source and kind), then
 * Bulk. `*received` is set if this returns `SINEW_OK`; settle it when it has been handled. Up to 1024 may be
 * unsettled; one more is `SINEW_ERROR_TOO_MANY`, and stays in its queue. With 0 it only polls.
 * `SINEW_ERROR_BUSY` in a function that a guard calls, if this endpoint sends or guards protected payloads.
 * The endpoint's thread.
 *
 * Signals do not end the wait: a loop that has to end at a signal uses a short `within_ns` and checks each
 * time.
 */
sinew_status sinew_receive_message(struct sinew_endpoint *endpoint,
                                   uint64_t within_ns,
                                   struct sinew_received *received);

/**
 * Gives the next report of unconfirmed messages that were not delivered, by this node or another: one for
 * each destination, type and reason, with the number of messages; `SINEW_NOTHING` if there is nothing new.
 * Does not block. The first rejection is reported at once, later ones every 100 ms together. `*undelivered`
 * is set if this returns `SINEW_OK`. This endpoint itself rejects messages if more arrive during a wait for
 * an answer than it keeps then (16,384 messages of each class, 4 MiB and one message). Those are counted
 * with its own TID as the destination. The endpoint's thread.
 */
sinew_status sinew_next_undelivered(struct sinew_endpoint *endpoint, struct sinew_undelivered *undelivered);

/**
 * Gives the time since a message was sent, with an error of up to its `sent_error_ns`. Returns whether that
 * is known, and leaves `*age_ns` unchanged if not: the clock of the sender's host is not measured yet, or
 * may be wrong by more than 32 s. Any thread.
 */
bool sinew_age(const struct sinew_received *received, uint64_t *age_ns);

/**
 * Gives the maximum age of a message: its age plus the error. Returns whether that is known, and leaves
 * `*age_ns` unchanged if not. Any thread.
 */
bool sinew_age_at_most(const struct sinew_received *received, uint64_t *age_ns);

/**
 * Whether a message may be older than `limit_ns`: for a program that may use fresh values only. An unknown
 * age counts as too old, and so does NULL. Any thread.
 */
bool sinew_is_older_than(const struct sinew_received *received, uint64_t limit_ns);

/**
 * Settles a received message: reports its outcome to the sender, if that requested it, and frees its memory.
 * `outcome` is `SINEW_DELIVERED` if it was handled, `SINEW_FAILED`, or one of the rejections. `*received` is
 * all zeros then; after an error it is still unsettled. The endpoint's thread. Does not block.
 */
sinew_status sinew_settle_message(struct sinew_endpoint *endpoint,
                                  struct sinew_received *received,
                                  int32_t outcome);

/**
 * Creates a message with a typed value: `*value` is a struct of this type; `value` may be NULL for a type
 * without fields. The type gives the class and the time to live. The bytes are MessagePack with the names of
 * the fields, which Rust reads as the `payload!` of the same name. Pass the message to any function that
 * sends, like one of `sinew_create_message`. `SINEW_ERROR_INVALID_ARGUMENT` with the field's name if the
 * value cannot be written: a text that is not UTF-8, a count above the array. Does not block. The endpoint's
 * thread.
 */
sinew_status sinew_create_value(struct sinew_endpoint *endpoint,
                                sinew_tid destination,
                                const struct sinew_payload_type *payload_type,
                                const void *value,
                                struct sinew_message *message);

/**
 * Reads a received message as a typed value: `*value` is a struct of this type, which is written if this
 * returns `SINEW_OK`. `value` may be NULL for a type without fields; nothing is written then.
 * `SINEW_NOTHING` if the message is of another kind. `SINEW_ERROR_MALFORMED` with the field's name if it
 * cannot be read: the field is missing, of another type, or its value does not fit. Then settle the message
 * as `SINEW_REJECTED_MALFORMED`. Fields that the type does not have are skipped. Any thread.
 */
sinew_status sinew_read_value(const struct sinew_received *received,
                              const struct sinew_payload_type *payload_type,
                              void *value);

/**
 * Writes a typed value as MessagePack to `bytes`, which has room for `room` bytes, for a protected payload,
 * a file, or a bus of your own. `*length` is the length of the encoded value, also if this returns
 * `SINEW_ERROR_TOO_LONG` because there is less room. `bytes` may be NULL if `room` is 0. Any thread.
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
 * Arrives at a barrier and waits until all parties have arrived, at most for `within_ns` of the barrier.
 * `*generation` is the number of times that the barrier has opened, the same for all parties that continue
 * together (1 for a phase); `generation` may be NULL. Messages that arrive meanwhile wait to be received.
 * `SINEW_ERROR_NOT_MET`: not all arrived in time. `SINEW_ERROR_PARTY_LOST`: one was lost, and the flags say
 * not to wait for it. The sentence of both says which parties are missing, and why. `SINEW_ERROR_REFUSED`:
 * this endpoint is not one of the parties, or the barrier is invalid; the sentence says why. After any other
 * error the endpoint counts as arrived until the barrier's time is over. The endpoint's thread.
 */
sinew_status sinew_meet(struct sinew_endpoint *endpoint,
                        const struct sinew_barrier *barrier,
                        uint64_t *generation);

/**
 * Presses the stop of the whole system: every guarded output of every node becomes safe, and stays so until
 * an operator has released the stop, and each application has acknowledged it and armed its output again. It
 * is no safety function.
 *
 * Returns when all nodes have confirmed, and after `within_ns` at the latest, which counts as 60 s at most.
 * Then the first `capacity` nodes are in `nodes`, which may be NULL, and the state is in `*report`, which may
 * be NULL. Look at `is_confirmed`: `SINEW_OK` says only that the node has answered. A `reason` that cannot be
 * read is replaced, so that a wrong argument hinders no press. After an error the stop may be pressed; try
 * again, and cut the power. `SINEW_ERROR_LOAN_ACTIVE` and `SINEW_ERROR_BUSY`: it was not pressed; a button
 * has an endpoint of its own. The endpoint's thread.
 */
sinew_status sinew_press_stop(struct sinew_endpoint *endpoint,
                              struct sinew_text reason,
                              uint64_t within_ns,
                              struct sinew_stop_node *nodes,
                              size_t capacity,
                              struct sinew_stop_report *report);

/**
 * Asks the endpoint's node for the state of the stop, and waits at most for `within_ns`. The results are
 * those of `sinew_press_stop`. The endpoint's thread.
 */
sinew_status sinew_ask_stop(struct sinew_endpoint *endpoint,
                            uint64_t within_ns,
                            struct sinew_stop_node *nodes,
                            size_t capacity,
                            struct sinew_stop_report *report);

/**
 * Acknowledges a stop that is released, and waits at most for `within_ns`: before that the outputs of this
 * endpoint cannot be armed, as its node hands over none of its echoes. Call it on the order of a person, or
 * of the application that coordinates the start. It moves nothing. `SINEW_ERROR_NOT_HANDLED`: a stop is in
 * force. The endpoint's thread.
 */
sinew_status sinew_acknowledge_stop(struct sinew_endpoint *endpoint, uint64_t within_ns);

/**
 * Gives a type of protected payloads, for a message each `period_ns`: two may be late or missing, one in 64
 * bad, and the output may be armed after eight good ones; a message is too old after eight periods. As
 * `Protection::of_period` in Rust. `length` is that of each payload in bytes, 0 for any; class Control.
 * `name` is kept as a pointer. Any thread.
 */
struct sinew_protected_type sinew_protected_type_of(struct sinew_text name,
                                                    size_t length,
                                                    uint64_t period_ns);

/**
 * Seals a payload and sends it to one application; no other receiver accepts it. The library adds the
 * counter, the incarnation and the echo. Echoes arrive while this endpoint is in `sinew_receive_message`, so
 * call that at least four times in `age_max_ns`, with 0 to only poll: without an echo the receiver rejects
 * each message as too old. The payload is at most `sinew_payload_max` less `SINEW_SEALED_OVERHEAD` bytes
 * long. An endpoint has at most 1,024 flows, each of one type to one receiver: one more is
 * `SINEW_ERROR_TOO_MANY`. Blocks as `sinew_send_message`. The endpoint's thread.
 */
sinew_status sinew_send_protected(struct sinew_endpoint *endpoint,
                                  sinew_tid destination,
                                  const struct sinew_protected_type *payload_type,
                                  const void *bytes,
                                  size_t length);

/**
 * As `sinew_send_protected`, and waits for room as `sinew_room_within` says. A message that was not sent
 * counts as missing at the receiver. The endpoint's thread.
 */
sinew_status sinew_send_protected_within(struct sinew_endpoint *endpoint,
                                         sinew_tid destination,
                                         const struct sinew_protected_type *payload_type,
                                         const void *bytes,
                                         size_t length,
                                         uint64_t within_ns);

/**
 * Seals a payload for a sender that uses another transport than an endpoint, and keeps the counter itself:
 * writes `length + SINEW_SEALED_OVERHEAD` bytes to `sealed`. Its `capacity` is at least that. The two must
 * not overlap. Any thread.
 */
sinew_status sinew_seal(const struct sinew_data_id *data_id,
                        const struct sinew_stamp *stamp,
                        const void *bytes,
                        size_t length,
                        uint8_t *sealed,
                        size_t capacity);

/**
 * Checks that these bytes were sealed under this data ID, and gives the sender's stamp; the payload begins
 * at `SINEW_SEALED_HEAD` and is `SINEW_SEALED_OVERHEAD` bytes shorter than `length`. `SINEW_ERROR_MALFORMED`
 * if not. This alone detects only damage and wrong addresses: to act on a message pass it to a guard,
 * `sinew_check_sealed`. Any thread.
 */
sinew_status sinew_unseal(const struct sinew_data_id *data_id,
                          const void *sealed,
                          size_t length,
                          struct sinew_stamp *stamp);

/**
 * Guards `output`: only messages of a protected type that `source` sends to this endpoint move it. `safe` is
 * called to make it safe: at once, since it is not armed, and each time it stops being live. From now on
 * `sinew_receive_message` delivers messages of that type, without their envelopes, only if they are good,
 * come from this sender, and arrive while the output is live. All others are rejected and counted. Act on
 * these messages in `sinew_apply` only.
 *
 * The sender has to quote echoes, which are sent to it while this endpoint is in `sinew_receive_message`:
 * call that at least four times in `age_max_ns`. If this endpoint or its sender returns under another
 * address, create the guards anew. `output` may be NULL, and must stay valid until `sinew_release` has
 * released it. Release it before the end of `main`, too. A process has at most 256 guards. The first one
 * starts the thread `safe-output`, which runs the watchdogs with the real-time priority 90, or the highest
 * that is granted (`ulimit -r`). `SINEW_ERROR_SAFE_FAILS`: the first call of `safe` has failed and is
 * retried; the guard is created all the same, and `*guard` set. The endpoint's thread.
 */
sinew_status sinew_guard_output(struct sinew_endpoint *endpoint,
                                sinew_tid source,
                                const struct sinew_protected_type *payload_type,
                                void *output,
                                sinew_make_safe safe,
                                struct sinew_guard **guard);

/**
 * As `sinew_guard_output`, for messages from another transport than an endpoint: pass each one to
 * `sinew_check_sealed`, and send the result of `sinew_guard_echo` to the sender. The name in the data ID
 * counts, not that of the type. Needs no node. `*guard` is set after `SINEW_ERROR_SAFE_FAILS`, too. Any
 * thread.
 */
sinew_status sinew_guard_alone(const struct sinew_data_id *data_id,
                               const struct sinew_protected_type *payload_type,
                               void *output,
                               sinew_make_safe safe,
                               struct sinew_guard **guard);

/**
 * Checks a sealed message with a guard. `SINEW_OK`: it is good and the output is live; its payload begins at
 * `SINEW_SEALED_HEAD` and is `SINEW_SEALED_OVERHEAD` bytes shorter. `SINEW_NOTHING`: do not use it, since it
 * is bad, or the output is safe. `*fault` is set in both cases; `fault` may be NULL. Pass each message once:
 * the second time it counts as repeated. Any thread.
 */
sinew_status sinew_check_sealed(struct sinew_guard *guard,
                                const void *sealed,
                                size_t length,
                                sinew_sealed_fault *fault);

/**
 * Gives the time that the sender has to quote as `echo_ns` of its next messages, on the clock of
 * `sinew_now_ns`. Send it to the sender four times in `age_max_ns`: the last eight count. For
 * `sinew_guard_alone`; an endpoint sends its echoes itself. Any thread.
 */
sinew_status sinew_guard_echo(struct sinew_guard *guard, uint64_t *at_ns);

/**
 * Makes the output live: from now on commands pass. Call it when a person has checked that it is safe to
 * move. Nothing does this automatically, and a live output that has become safe stays so until this is
 * called again. `SINEW_ERROR_NOT_GOOD` until `good_min` good messages in a row have arrived, the last one in
 * time; `SINEW_ERROR_SAFE_FAILS` if the output could not be made safe. Any thread.
 */
sinew_status sinew_arm(struct sinew_guard *guard);

/**
 * Calls `command` with the output and `argument` if the output is live; `safe` of the guard does not run
 * meanwhile. `SINEW_NOTHING`: the output is safe, and `command` was not called. `SINEW_ERROR_SAFE_FAILS`:
 * the same, but making it safe has failed so far. `*state` gives the state and its cause in all three cases;
 * `state` may be NULL. Blocks while another thread uses the output. Any thread.
 */
sinew_status sinew_apply(struct sinew_guard *guard,
                         sinew_command command,
                         void *argument,
                         sinew_output_state *state);

/**
 * Makes the output safe: at once or, while another thread uses it, as soon as that ends. Does not block, and
 * may be called from the functions that a guard calls. Any thread.
 */
sinew_status sinew_trip(struct sinew_guard *guard);

/**
 * Gives whether commands reach the output now and, if not, the cause. `SINEW_ERROR_SAFE_FAILS`: they do not,
 * but making it safe has failed so far, so that it may still move; `*state` is set all the same. Any thread.
 */
sinew_status sinew_guard_state(struct sinew_guard *guard, sinew_output_state *state);

/**
 * Gives the counts of a guard since it was created. Any thread.
 */
sinew_status sinew_guard_tally(struct sinew_guard *guard, struct sinew_tally *tally);

/**
 * Makes the output safe and releases the guard: after `SINEW_OK` the library calls no function of it any
 * more, and `*guard` is NULL. After `SINEW_ERROR_SAFE_FAILS` the library keeps trying, and releases it as
 * soon as the output is safe. The output must stay valid until then, which is when another call returns
 * `SINEW_OK` or `SINEW_ERROR_NO_SUCH_GUARD`. Messages of its type to its endpoint are still rejected. Blocks
 * while another thread uses the output. Any thread.
 */
sinew_status sinew_release(struct sinew_guard **guard);

/**
 * As `sinew_release`, for the functions that a guard calls, which must not wait. Makes the output safe as
 * `sinew_trip` does, and releases the guard as soon as no thread uses the output any more and it is safe.
 * `*guard` is NULL then, and all calls reject it. There is no notice of the library's last call of its
 * functions: `output` and `safe` of the guard must stay valid until the end of the process. Does not block.
 * Any thread.
 */
sinew_status sinew_release_later(struct sinew_guard **guard);

/**
 * Gives a text for an output's state, one of `sinew_output_state`. Never NULL. Any thread.
 */
const char *sinew_output_state_text(int32_t state);

/**
 * Gives a text for a status: its general meaning. Never NULL. Any thread.
 */
const char *sinew_status_text(int32_t status);

/**
 * Gives a sentence about the last error of the calling thread: the cause in this case, and the remedy. Never
 * NULL; empty if there was no error. It stays until the thread's next error. Any thread, each of which has
 * its own.
 */
const char *sinew_last_error(void);

/**
 * Gives a text for an outcome. Never NULL. Any thread.
 */
const char *sinew_outcome_text(int32_t outcome);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

/** A text of a string literal. C only: in C++ use sinew.hpp, or sinew_text_of. */
#define SINEW_TEXT(literal) ((sinew_text){ "" literal, sizeof(literal) - 1 })

/** A text of a C string; an empty one if that is NULL. Any thread. */
static inline sinew_text sinew_text_of(const char *string)
{
    sinew_text text;
    text.bytes = string;
    text.length = string ? strlen(string) : 0;
    return text;
}

/* Tables of fields, for sinew_create_value and sinew_read_value. In C++ use SINEW_PAYLOAD and SINEW_STRUCT of sinew.hpp.
 *
 *   struct torque { double newton_metres; uint32_t number; float gains[3]; char mode[16]; };
 *   static const sinew_field torque_fields[] = {
 *       SINEW_FIELD(struct torque, newton_metres), SINEW_FIELD(struct torque, number),
 *       SINEW_FIELD(struct torque, gains), SINEW_FIELD(struct torque, mode) };
 *   static const sinew_payload_type torque_type = SINEW_PAYLOAD("knee.torque", SINEW_STREAM, struct torque, torque_fields);
 *
 * A type without fields, such as a command to stop, needs no struct and no table, and its `value` is NULL:
 *
 *   static const sinew_payload_type stop_type = SINEW_PAYLOAD_EMPTY("knee.stop", SINEW_CONTROL);
 *   sinew_create_value(drive, knee, &stop_type, NULL, &message);
 *   if (sinew_read_value(&received, &stop_type, NULL) == SINEW_OK) ...
 */

/** A payload type without fields: its name as a literal, and its class. In C from C99 on, and in C++. Rust's `payload!("knee.stop" => struct Stop)`. */
#define SINEW_PAYLOAD_EMPTY(name, message_class) { { "" name, sizeof(name) - 1 }, message_class, { NULL, 0, 0 }, 0 }
/** The same with a time to live in nanoseconds, a constant above 0: an older message expires in its queue. */
#define SINEW_PAYLOAD_EMPTY_EXPIRING(name, message_class, expires_after_ns) { { "" name, sizeof(name) - 1 }, message_class, { NULL, 0, 0 }, SINEW_TIME_ABOVE_ZERO(expires_after_ns) }
/* A time of 0 does not compile: the size of an array is negative. */
#define SINEW_TIME_ABOVE_ZERO(time_ns) ((time_ns) + 0 * sizeof(char[(time_ns) > 0 ? 1 : -1]))

/** Registers with the `SINEW_ABI` that the program was compiled with: a library with another one rejects it, with a sentence. */
#define sinew_register_transport_address(...) sinew_register_with_abi(SINEW_ABI, __VA_ARGS__)

#ifndef __cplusplus

#define SINEW_MEMBER(type, member) (((type *)0)->member)
#define SINEW_INT_TYPE(is_signed, size) ((size) == 1 ? ((is_signed) ? SINEW_TYPE_I8 : SINEW_TYPE_U8) : (size) == 2 ? ((is_signed) ? SINEW_TYPE_I16 : SINEW_TYPE_U16) : (size) == 4 ? ((is_signed) ? SINEW_TYPE_I32 : SINEW_TYPE_U32) : ((is_signed) ? SINEW_TYPE_I64 : SINEW_TYPE_U64))
/* A type that is not in this list, such as a lone `char` or a pointer, does not compile. */
#define SINEW_TYPE_OF(value) _Generic((value), bool: SINEW_TYPE_BOOL, bool *: SINEW_TYPE_BOOL, float: SINEW_TYPE_F32, float *: SINEW_TYPE_F32, double: SINEW_TYPE_F64, double *: SINEW_TYPE_F64, char *: SINEW_TYPE_TEXT, signed char: SINEW_TYPE_I8, signed char *: SINEW_TYPE_I8, unsigned char: SINEW_TYPE_U8, unsigned char *: SINEW_TYPE_U8, short: SINEW_INT_TYPE(1, sizeof(short)), short *: SINEW_INT_TYPE(1, sizeof(short)), unsigned short: SINEW_INT_TYPE(0, sizeof(short)), unsigned short *: SINEW_INT_TYPE(0, sizeof(short)), int: SINEW_INT_TYPE(1, sizeof(int)), int *: SINEW_INT_TYPE(1, sizeof(int)), unsigned: SINEW_INT_TYPE(0, sizeof(int)), unsigned *: SINEW_INT_TYPE(0, sizeof(int)), long: SINEW_INT_TYPE(1, sizeof(long)), long *: SINEW_INT_TYPE(1, sizeof(long)), unsigned long: SINEW_INT_TYPE(0, sizeof(long)), unsigned long *: SINEW_INT_TYPE(0, sizeof(long)), long long: SINEW_TYPE_I64, long long *: SINEW_TYPE_I64, unsigned long long: SINEW_TYPE_U64, unsigned long long *: SINEW_TYPE_U64)
#define SINEW_ARRAY_OF(value) _Generic((value), bool *: SINEW_FIELD_ARRAY, float *: SINEW_FIELD_ARRAY, double *: SINEW_FIELD_ARRAY, signed char *: SINEW_FIELD_ARRAY, unsigned char *: SINEW_FIELD_ARRAY, short *: SINEW_FIELD_ARRAY, unsigned short *: SINEW_FIELD_ARRAY, int *: SINEW_FIELD_ARRAY, unsigned *: SINEW_FIELD_ARRAY, long *: SINEW_FIELD_ARRAY, unsigned long *: SINEW_FIELD_ARRAY, long long *: SINEW_FIELD_ARRAY, unsigned long long *: SINEW_FIELD_ARRAY, default: 0)
#define SINEW_FIELD_RAW(type, member, extra, layout, field_type, flags) { #member, offsetof(type, member), sizeof SINEW_MEMBER(type, member), extra, layout, field_type, flags }

/** A field that is a bool, a number, an array of these, or a text (an array of char that ends with a zero). */
#define SINEW_FIELD(type, member) SINEW_FIELD_RAW(type, member, 0, NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_ARRAY_OF(SINEW_MEMBER(type, member)))
/** An array; the `size_t` member `count` is the number of its elements in use. */
#define SINEW_FIELD_LIST(type, member, count) SINEW_FIELD_RAW(type, member, offsetof(type, count), NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_FIELD_ARRAY | SINEW_FIELD_COUNTED)
/** A field that has a value if the `bool` member `is_there` is true. */
#define SINEW_FIELD_MAYBE(type, member, is_there) SINEW_FIELD_RAW(type, member, offsetof(type, is_there), NULL, SINEW_TYPE_OF(SINEW_MEMBER(type, member)), SINEW_FIELD_OPTIONAL | SINEW_ARRAY_OF(SINEW_MEMBER(type, member)))
/** An array of `uint8_t` that is written as bytes; the `size_t` member `count` is the number of bytes in use. */
#define SINEW_FIELD_BYTES(type, member, count) SINEW_FIELD_RAW(type, member, offsetof(type, count), NULL, SINEW_TYPE_BYTES, SINEW_FIELD_COUNTED)
/** A field that is a struct with this `sinew_layout`. */
#define SINEW_FIELD_STRUCT(type, member, layout) SINEW_FIELD_RAW(type, member, 0, &(layout), SINEW_TYPE_STRUCT, 0)
/** An array of structs with this `sinew_layout`. */
#define SINEW_FIELD_STRUCTS(type, member, layout) SINEW_FIELD_RAW(type, member, 0, &(layout), SINEW_TYPE_STRUCT, SINEW_FIELD_ARRAY)
/** The table of a struct. */
#define SINEW_LAYOUT(type, fields) { fields, sizeof(fields) / sizeof(fields)[0], sizeof(type) }
/** The table of a struct that is a field and has no fields in Rust. C requires a member, which is not sent: `struct none { char unused; };`. */
#define SINEW_LAYOUT_EMPTY(type) { NULL, 0, sizeof(type) }
/** A payload type: its name as a literal, its class, its struct, and the array of its fields. */
#define SINEW_PAYLOAD(name, message_class, type, fields) { { "" name, sizeof(name) - 1 }, message_class, SINEW_LAYOUT(type, fields), 0 }
/** The same with a time to live in nanoseconds, a constant above 0: an older message expires in its queue. */
#define SINEW_PAYLOAD_EXPIRING(name, message_class, expires_after_ns, type, fields) { { "" name, sizeof(name) - 1 }, message_class, SINEW_LAYOUT(type, fields), SINEW_TIME_ABOVE_ZERO(expires_after_ns) }

#endif

#endif /* SINEW_H */

//! The rows of the tables `[[command]]`, in the order of the reader's keys.

use sinew_runtime::{
    app::{CommandReadiness, DownPolicy},
    supervision::Restart,
};

use super::{
    rows::{millis, path},
    *,
};
use crate::config::{CommandConfig, command::COMMAND_REQUIRES_MAX};

/// Returns the first command of a configuration, or one with all defaults.
fn command(config: &NodeConfig) -> CommandConfig {
    config.commands.first().cloned().unwrap_or_else(|| CommandConfig::new("", [""; 0]))
}

/// One row per key; a test compares them with the keys that the reader accepts.
pub(super) const COMMAND_ROWS: &[Row] = &[
    Row {
        key: "command.name",
        kind: Kind::Name,
        value: |config| json!(command(config).name),
        effect: "Name of the application, which its program registers; other processes cannot register it.",
        note: "The program finds it in `SINEW_NAME`.",
    },
    Row {
        key: "command.run",
        kind: Kind::Words(sinew_runtime::app::COMMAND_WORDS_MAX),
        value: |config| {
            let run = command(config).run;
            if run.is_empty() { Value::Null } else { json!(run) }
        },
        effect: "The program, by its path or its name in `PATH`, and its arguments.",
        note: "It finds the path of the socket in `SINEW_SOCKET`. Its lines of output go to the node's log.",
    },
    Row {
        key: "command.folder",
        kind: Kind::PathOrFalse(DIRECTORY_BYTES_MAX),
        value: |config| path(command(config).folder.as_deref()),
        effect: "Working directory of the program; `false` is that of the node.",
        note: "",
    },
    Row {
        key: "command.requires",
        kind: Kind::Names(COMMAND_REQUIRES_MAX),
        value: |config| json!(command(config).requires),
        effect: "Requirements that are met before the program is started.",
        note: "They are those of `AppSpec::requires`: names, patterns, alternatives and counts.",
    },
    Row {
        key: "command.restart",
        kind: Kind::OneOf(&["permanent", "transient", "temporary"]),
        value: |config| match command(config).restart {
            Restart::Permanent => json!("permanent"),
            Restart::Transient => json!("transient"),
            Restart::Temporary => json!("temporary"),
        },
        effect: "Whether the program is started again after each end, after a failure only, or never.",
        note: "Exit code 0 is no failure. Restarts count for `supervision.app_restarts_max`.",
    },
    Row {
        key: "command.ready",
        kind: Kind::OneOf(&["registered", "called"]),
        value: |config| match command(config).readiness {
            CommandReadiness::Registered => json!("registered"),
            CommandReadiness::Called => json!("called"),
        },
        effect: "Whether the application is ready when its program has registered, or when it has called `ready` as well.",
        note: "Clients in Rust and Python have this call. `hang_ms` counts from the readiness on.",
    },
    Row {
        key: "command.while_down",
        kind: Kind::OneOf(&["hold", "drop"]),
        value: |config| match command(config).while_down {
            DownPolicy::Hold | DownPolicy::HoldFor(_) => json!("hold"),
            DownPolicy::Drop => json!("drop"),
        },
        effect: "Whether messages wait for the next process, or are rejected while none is registered.",
        note: "Use `drop` for setpoints, which are stale after a restart.",
    },
    Row {
        key: "command.start_ms",
        kind: Kind::Number(COMMAND_START),
        value: |config| millis(command(config).start),
        effect: "Time for the program to become ready; after it the program is killed and started again.",
        note: "A program that loses its connection has as long to register again.",
    },
    Row {
        key: "command.stop_ms",
        kind: Kind::Number(COMMAND_STOP),
        value: |config| millis(command(config).stop),
        effect: "Time from SIGTERM to SIGKILL at a stop, for all processes of its group.",
        note: "",
    },
    Row {
        key: "command.hang_ms",
        kind: Kind::NumberOrFalse(COMMAND_HANG),
        value: |config| command(config).hang.map_or_else(|| json!(false), millis),
        effect: "Time after which a program that reads nothing and sends nothing is killed and started again.",
        note: "A pause of the GIL of Python counts. A client without shared memory is watched only while its socket is full.",
    },
    Row {
        key: "command.backoff_min_ms",
        kind: Kind::Number(COMMAND_BACKOFF_MIN),
        value: |config| millis(command(config).backoff_min),
        effect: "First wait before a restart; it doubles with each consecutive failure.",
        note: "",
    },
    Row {
        key: "command.backoff_max_ms",
        kind: Kind::Number(COMMAND_BACKOFF_MAX),
        value: |config| millis(command(config).backoff_max),
        effect: "Longest wait before a restart.",
        note: "",
    },
];

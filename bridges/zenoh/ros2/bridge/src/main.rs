//! `sinew-ros2 FILE`: shows a node's messages, parameters and stop to ROS 2 over Zenoh routers, and lets commands in.

use std::{path::PathBuf, process::ExitCode};

use sinew_ros2::{load, run};
use tracing::error;

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn,sinew_ros2=info");
    let mut arguments = std::env::args_os().skip(1);
    let (Some(file), None) = (arguments.next().map(PathBuf::from), arguments.next()) else {
        error!("usage: sinew-ros2 FILE; bridges/zenoh/README.md describes the file");
        return ExitCode::from(2);
    };
    let loaded = match load::load(&file) {
        Ok(loaded) => loaded,
        Err(error) => {
            error!("{error}");
            return ExitCode::from(2);
        }
    };
    // It ends by a signal, or when one of its parts has ended.
    error!("{}", run::run(loaded));
    ExitCode::FAILURE
}

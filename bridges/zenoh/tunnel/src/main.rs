//! `sinew-zenoh FILE`: carries the packets of this host's nodes over Zenoh routers.

use std::{path::PathBuf, process::ExitCode};

use sinew_zenoh::{config::Config, tunnel};
use tracing::error;

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn,sinew_zenoh=info");
    let mut arguments = std::env::args_os().skip(1);
    let (Some(file), None) = (arguments.next().map(PathBuf::from), arguments.next()) else {
        error!("usage: sinew-zenoh FILE; bridges/zenoh/README.md describes the file");
        return ExitCode::from(2);
    };
    let config = match Config::read(&file) {
        Ok(config) => config,
        Err(error) => {
            error!("{error}");
            return ExitCode::from(2);
        }
    };
    if config.settings.key.is_none() {
        tracing::warn!("key = false: every router reads and forges the packets of nodes");
    }
    match tunnel::run(config) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            error!("{error}");
            ExitCode::FAILURE
        }
    }
}

//! `sinew up`, `down` and `status`: a robot from one file, on this host and on others.
//!
//! The plan is pure (`plan`). A host is asked by a session (`session`). At its other end the same program
//! places files, starts and ends processes (`agent`).

mod agent;
mod down;
mod ended;
mod fleet;
mod gather;
mod inspect;
mod order;
mod plan;
mod protocol;
mod robot;
mod run;
mod session;
mod status;
mod systemd;
mod units;
mod wait;

use std::{
    io,
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::Args;

use crate::{Report, system::SystemError};
use robot::Robot;

/// The arguments of `sinew up`.
#[derive(Debug, Args)]
pub(crate) struct UpOrder {
    #[command(flatten)]
    file: FileOrder,
    /// Print the plan, and change nothing. Where another host lacks this program, it is copied there all the same
    #[arg(long)]
    dry_run: bool,
    /// Place the files and write units of systemd on each host, and start nothing: notification of readiness, a
    /// watchdog that progress feeds, real-time limits. It prints the commands that install them
    #[arg(long, conflicts_with = "dry_run")]
    systemd: bool,
}

/// The robot file.
#[derive(Debug, Args)]
pub(crate) struct FileOrder {
    /// The robot file
    #[arg(value_name = "FILE", default_value = "robot.toml")]
    file: PathBuf,
}

/// The arguments of `sinew host`, which `sinew up` runs on each host.
#[derive(Debug, Args)]
pub(crate) struct HostOrder {
    /// Become the program of a node
    #[arg(long)]
    launch: bool,
}

/// Starts the robot, or changes it to its file.
pub(crate) fn up(order: &UpOrder, (is_json, is_wide): (bool, bool)) -> Result<Report, SystemError> {
    let robot = read(&order.file.file)?;
    let printer = run::Printer { is_json, is_wide };
    if order.systemd { systemd::write(&robot, printer) } else { run::up(&robot, order.dry_run, printer) }
}

/// Stops the robot, and removes its files.
pub(crate) fn down(order: &FileOrder, (is_json, is_wide): (bool, bool)) -> Result<Report, SystemError> {
    down::down(&read(&order.file)?, run::Printer { is_json, is_wide })
}

/// Shows the nodes of the robot on all its hosts.
pub(crate) fn status(order: &FileOrder, is_wide: bool) -> Result<Report, SystemError> {
    Ok(status::show(&read(&order.file)?, is_wide))
}

/// Shows the logs of the nodes' processes on all hosts.
pub(crate) fn logs(file: &Path, node: Option<&str>) -> Result<Report, SystemError> {
    status::logs(&read(file)?, node)
}

/// Serves `sinew up` on a host, by the standard streams.
pub(crate) fn host(order: &HostOrder) -> ExitCode {
    if order.launch {
        return agent::launched();
    }
    let served = agent::serve(&mut io::stdin().lock(), &mut io::stdout().lock(), inspect::inspect);
    // Its caller has gone, which ends the session.
    if served.is_ok() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn read(path: &Path) -> Result<Robot, SystemError> {
    let faults = |faults| SystemError::Up(format!("this is no robot file:\n{faults}"));
    Robot::from_file(path).map_err(faults)
}

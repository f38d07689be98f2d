//! The drive of one joint on a recorded walk, for `sinew play --check`: `exoskeleton check-drive JOINT`.

use std::process::ExitCode;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::DriveTick;
use exoskeleton_recording::replay;
use sinew::prelude::*;
use sinew::replay::exchange::VARIABLE;
use thiserror::Error;

use super::edges::{TICKS, drive_name};

/// The project of the node, which is that of no robot.
const PROJECT: &str = "replay";

/// The reason why a drive is not checked.
#[derive(Debug, Error)]
pub enum CheckDriveError {
    /// No check has started this program.
    #[error(
        "check-drive {joint}: no check has started this program; run `sinew play --check walk.mcap --turns {turns} -- \
         exoskeleton check-drive {joint}`",
        turns = DriveTick::NAME
    )]
    NotChecked {
        /// The joint.
        joint: Joint,
    },
    /// The check cannot begin.
    #[error(transparent)]
    Start(#[from] StartError),
}

/// Declares the drive of a joint on a recorded walk, with this factor for its gains. It has no device.
#[must_use]
pub fn spec(joint: Joint, gain_factor: f64) -> AppSpec<replay::ReplayedDrive> {
    replay::spec(drive_name(joint), Tid::group(TICKS), joint, gain_factor)
}

/// Runs the check that has started this program, and ends the process with its result.
///
/// # Errors
/// No check has started this program, or the check cannot begin.
pub fn run(joint: Joint, gain_factor: f64) -> Result<ExitCode, CheckDriveError> {
    if std::env::var_os(VARIABLE).is_none() {
        return Err(CheckDriveError::NotChecked { joint });
    }
    let builder = Node::builder("check-drive").address([127, 0, 0, 1]);
    let builder = builder.configure(|config| PROJECT.clone_into(&mut config.project));
    // The check ends this process. Without a drive of this joint in the recording the command reports that. With a
    // variable that was left behind a node starts which has no device, in the project of no robot.
    Ok(builder.app(spec(joint, gain_factor)).start()?.run())
}

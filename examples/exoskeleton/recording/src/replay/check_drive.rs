//! The process of one joint's drive on a recorded walk, for `sinew play --check`: `exoskeleton check-drive JOINT`.

use std::process::ExitCode;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::DriveTick;
use sinew::prelude::*;
use sinew::replay::exchange::VARIABLE;
use thiserror::Error;

use super::ReplayedDrive;

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

/// Runs the check that has started this program on the drive of this joint, which [`spec`](super::spec)
/// declares. Ends the process with its result.
///
/// # Errors
/// No check has started this program, or the check cannot begin.
pub fn run(joint: Joint, drive: AppSpec<ReplayedDrive>) -> Result<ExitCode, CheckDriveError> {
    if std::env::var_os(VARIABLE).is_none() {
        return Err(CheckDriveError::NotChecked { joint });
    }
    let builder = Node::builder("check-drive").address([127, 0, 0, 1]);
    let builder = builder.configure(|config| PROJECT.clone_into(&mut config.project));
    // The check ends this process. Without a drive of this joint in the recording the command reports that. With a
    // variable that was left behind a node starts which has no device, in the project of no robot.
    Ok(builder.app(drive).start()?.run())
}

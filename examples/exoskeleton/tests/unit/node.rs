//! Tests of `src/robot/node.rs`.

use super::*;

/// Returns how often a folder is tried, if its parent is removed `removals` times meanwhile, and the result.
fn tries(removals: usize) -> (usize, io::Result<()>) {
    let mut tries = 0;
    let created = create_again(|| {
        tries += 1;
        if tries <= removals { Err(io::ErrorKind::NotFound.into()) } else { Ok(()) }
    });
    (tries, created)
}

#[test]
fn folder_is_created_again_if_its_parent_is_removed() {
    assert!(matches!(tries(0), (1, Ok(()))));
    assert!(matches!(tries(7), (8, Ok(()))));
    let (count, result) = tries(usize::MAX);
    assert_eq!((count, result.map_err(|error| error.kind())), (8, Err(io::ErrorKind::NotFound)));
}

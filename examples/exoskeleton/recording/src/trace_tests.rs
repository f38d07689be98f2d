//! Tests of the traces.

use super::*;

fn folder(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("exoskeleton-trace-{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn rows_read_back_by_incarnation() {
    let folder = folder("incarnations");
    let row = PlantRow {
        t_ns: 5,
        late_us: 3,
        strides: 1.5,
        walking: true,
        angle_rad: [0.1, 0.2, 0.3],
        velocity_rad_s: [1.0, 2.0, 3.0],
        intended_rad: [0.4, 0.5, 0.6],
        applied_nm: [0.0, -1.0, 2.5],
        commanded_nm: [None, Some(7.0), None],
        state: [Some(DriveState::Walk), None, Some(DriveState::Safe)],
        saturated: [false, true, false],
        watchdog: [true, false, false],
    };
    for strides in [1.5, 2.5] {
        let recording = Recording::begin(Some(&folder), "plant").unwrap();
        let trace = recording.trace();
        trace.note(PlantRow { strides, ..row });
        trace.note(PlantRow { strides, t_ns: 6, ..row });
        assert_eq!(recording.finish(), 0);
    }
    let incarnations: Vec<Vec<PlantRow>> = read_incarnations(&folder, "plant").unwrap();
    assert_eq!(incarnations.len(), 2);
    assert_eq!(incarnations[0][0], row);
    assert_eq!(incarnations[1].len(), 2);
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn truncated_last_row_is_omitted() {
    let folder = folder("cut");
    let text = format!("{}\n1,2,0.5,1.0,2,0\n2,3,0.", GaitRow::HEADER);
    std::fs::write(folder.join("central-1.csv"), text).unwrap();
    let incarnations: Vec<Vec<GaitRow>> = read_incarnations(&folder, "central").unwrap();
    assert_eq!(incarnations[0].len(), 1);
    assert_eq!(incarnations[0][0].mode, Some(GaitMode::Walk));
    std::fs::remove_dir_all(&folder).unwrap();
}

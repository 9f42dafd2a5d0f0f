use anyhow::{Context, bail, ensure};
use crossfix_geometry::Pose;
use crossfix_message::{MOST_POSITION_SD, MOST_ROTATION_SD};
use nalgebra::{Matrix3, Point3};
use serde::{Deserialize, Serialize};

/// Position and orientation of a camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseConfig {
    /// Camera centre, local ENU, m.
    pub position_m: [f64; 3],
    /// A point on the camera's optical axis, m; the camera is level. Either this or `rotation`.
    pub look_at_m: Option<[f64; 3]>,
    /// The rotation world_from_camera, row by row: its columns are the camera's axes (x right,
    /// y down, z forward) in the world.
    pub rotation: Option<[[f64; 3]; 3]>,
    /// Standard deviation of the rotation about each axis, mrad. 0 to 1000. To be given together
    /// with `position_sd_m`. Absent: that of a careful survey (1 mrad, 5 cm) is assumed, and the
    /// pose's true accuracy is learnt from the sight lines.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_sd_mrad: Option<f64>,
    /// Standard deviation of the camera centre along each axis, m. 0 to 1000.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_sd_m: Option<f64>,
}

impl PoseConfig {
    /// A pose written as a rotation and a position.
    pub fn of(pose: &Pose) -> Self {
        let m = pose.rotation().matrix();
        let row = |r: usize| [m[(r, 0)], m[(r, 1)], m[(r, 2)]];
        let p = pose.position();
        Self {
            position_m: [p.x, p.y, p.z],
            look_at_m: None,
            rotation: Some([row(0), row(1), row(2)]),
            rotation_sd_mrad: None,
            position_sd_m: None,
        }
    }

    /// Standard deviations of the pose: rotation, rad, and position, m; `None` where they are not
    /// given.
    pub(super) fn deviations(&self) -> Option<(f64, f64)> {
        Some((self.rotation_sd_mrad? * 1e-3, self.position_sd_m?))
    }

    /// Checks that both deviations are given or neither, and that each is in range.
    fn check_deviations(&self) -> anyhow::Result<()> {
        let most = [MOST_ROTATION_SD * 1e3, MOST_POSITION_SD];
        let given = [self.rotation_sd_mrad, self.position_sd_m];
        let possible =
            given.iter().zip(most).all(|(sd, most)| sd.is_none_or(|sd| (0.0..=most).contains(&sd)));
        ensure!(
            possible && given[0].is_some() == given[1].is_some(),
            "give both `rotation_sd_mrad`, from 0 to {}, and `position_sd_m`, from 0 to {}, or \
             neither",
            most[0],
            most[1]
        );
        Ok(())
    }

    pub(super) fn pose(&self) -> anyhow::Result<Pose> {
        self.check_deviations()?;
        let position = Point3::from(self.position_m);
        match (self.look_at_m, self.rotation) {
            (Some(target), None) => {
                Pose::looking_at(position, Point3::from(target)).context("key `look_at_m`")
            }
            (None, Some(rows)) => {
                // nalgebra's From takes columns, so the rows are transposed.
                Pose::new(Matrix3::from(rows).transpose(), position).context(
                    "key `rotation` (rows of world_from_camera; its columns are the camera's x \
                     right, y down, z forward)",
                )
            }
            _ => bail!("give either `look_at_m` or `rotation`, and not both"),
        }
    }
}

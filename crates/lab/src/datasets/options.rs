//! How a data set is to be read.

use super::error::DatasetError;
use super::kind::Split;

/// How a data set is to be read. `None` is the data set's own default.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetOptions {
    /// Which part; the default is `test`, except `val` for MSLS and `train` for RobotCar, whose
    /// poses there are public.
    pub split: Option<Split>,
    /// Greatest distance of a positive in metres (paper IV: 25).
    pub radius_m: f64,
    /// Greatest difference of view angles of a positive in degrees; the default is 40 for MSLS,
    /// else no rule.
    pub max_angle_deg: Option<f64>,
    /// Greatest frame distance of a positive (Nordland).
    pub frame_tolerance: u64,
    /// Only these cities (MSLS); empty means the split's own.
    pub cities: Vec<String>,
    /// Exchange the two seasons: winter as the database, summer as the queries (Nordland).
    pub swap: bool,
    /// The column of `subtask_index.csv` (MSLS): all, s2w, w2s, o2n, n2o, d2n, n2d.
    pub subtask: String,
}

impl Default for DatasetOptions {
    fn default() -> Self {
        Self {
            split: None,
            radius_m: 25.0,
            max_angle_deg: None,
            frame_tolerance: 10,
            swap: false,
            cities: Vec::new(),
            subtask: "all".into(),
        }
    }
}

impl DatasetOptions {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The radius or the view angle is.
    pub fn check(&self) -> Result<(), DatasetError> {
        if !(self.radius_m.is_finite() && self.radius_m > 0.0) {
            return Err(DatasetError::Setting(format!(
                "the radius must be a positive number of metres, not {}",
                self.radius_m
            )));
        }
        match self.max_angle_deg {
            Some(angle) if !(0.0..=180.0).contains(&angle) => Err(DatasetError::Setting(format!(
                "the view angle must be 0 to 180 degrees, not {angle}"
            ))),
            _ => Ok(()),
        }
    }
}

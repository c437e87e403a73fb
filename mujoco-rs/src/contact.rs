use crate::id::{GeomId, ObjectId};

/// Contact that collision detection found in the last step or forward pass.
///
/// ```
/// use mujoco_rs::{Data, Model};
///
/// let model = Model::from_xml(
///     "<mujoco><worldbody><geom type='plane' size='1 1 1'/>
///     <body pos='0 0 .08'><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
/// )?;
/// let mut data = Data::new(model)?;
/// data.forward()?;
/// let depths: Vec<f64> = data.contacts().map(|contact| -contact.distance()).collect();
/// assert!(depths.len() == 1 && (depths[0] - 0.02).abs() < 1e-9, "a ball, 2 cm deep in the floor");
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
#[derive(Clone, Copy)]
pub struct Contact<'a>(pub(crate) &'a mujoco_sys::mjContact);

impl Contact<'_> {
    /// Returns the two geoms, in MuJoCo's order.
    pub fn geoms(&self) -> [GeomId; 2] {
        [GeomId::new(self.0.geom1 as usize), GeomId::new(self.0.geom2 as usize)]
    }

    /// Returns the distance between the nearest points, m; negative if the geoms penetrate.
    pub fn distance(&self) -> f64 {
        self.0.dist
    }

    /// Returns the midpoint of the two nearest points, world frame, m.
    pub fn position(&self) -> [f64; 3] {
        self.0.pos
    }

    /// Returns the unit normal from the first geom to the second, world frame.
    pub fn normal(&self) -> [f64; 3] {
        [self.0.frame[0], self.0.frame[1], self.0.frame[2]]
    }

    /// Returns true if the solver treats this as a contact; false if the geoms are only within their margin.
    pub fn is_active(&self) -> bool {
        self.0.exclude == 0
    }
}

impl std::fmt::Debug for Contact<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Contact")
            .field("geoms", &self.geoms())
            .field("distance", &self.distance())
            .field("position", &self.position())
            .field("normal", &self.normal())
            .finish()
    }
}

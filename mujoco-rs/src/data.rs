use std::fmt;
use std::ptr::{self, NonNull};
use std::sync::Arc;

use crate::contact::Contact;
use crate::error::{DivergedQuantity, Divergence, Error};
use crate::id::{GeomId, ObjectId};
use crate::model::{Model, ModelMut};
use crate::runtime::{check_library, guarded, was_raised};

/// State of one simulation of a [`Model`]; MuJoCo's `mjData`.
///
/// ```
/// use mujoco_rs::{Data, Model};
///
/// let model = Model::from_xml(
///     "<mujoco><option timestep='.002' integrator='RK4'/><worldbody>
///     <body pos='0 0 2'><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
/// )?;
/// let mut data = Data::new(model)?;
/// for _ in 0..100 {
///     data.step()?;
/// }
/// // free fall
/// let t = data.time();
/// assert!((data.qpos()[2] - (2.0 - 0.5 * 9.81 * t * t)).abs() < 1e-9);
/// # Ok::<(), mujoco_rs::Error>(())
/// ```
pub struct Data {
    pointer: NonNull<mujoco_sys::mjData>,
    model: Arc<Model>,
    /// Number of contacts of the last step, over all its stages; 0 after a forward pass.
    step_contacts: i32,
    /// Error that left MuJoCo's stack in an undefined state; only a reset clears it.
    broken: Option<Error>,
}

// SAFETY: an mjData is plain memory without thread affinity, and only this value owns it.
unsafe impl Send for Data {}

/// MuJoCo's warnings (`mjtWarning`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum WarningKind {
    /// The inertia matrix is nearly singular.
    Inertia,
    /// More contacts than `nconmax` were found; some were dropped.
    ContactFull,
    /// More constraints than `njmax` were found; some were dropped.
    ConstraintFull,
    /// A visual buffer was too small.
    VisualFull,
    /// A position was not finite or too large, and MuJoCo reset the simulation.
    BadPosition,
    /// A velocity was not finite or too large, and MuJoCo reset the simulation.
    BadVelocity,
    /// An acceleration was not finite or too large, and MuJoCo reset the simulation.
    BadAcceleration,
    /// A control was not finite, and MuJoCo set all controls to zero.
    BadControl,
}

impl WarningKind {
    fn index(self) -> usize {
        use mujoco_sys::mjtWarning_ as warning;
        (match self {
            Self::Inertia => warning::mjWARN_INERTIA,
            Self::ContactFull => warning::mjWARN_CONTACTFULL,
            Self::ConstraintFull => warning::mjWARN_CNSTRFULL,
            Self::VisualFull => warning::mjWARN_VGEOMFULL,
            Self::BadPosition => warning::mjWARN_BADQPOS,
            Self::BadVelocity => warning::mjWARN_BADQVEL,
            Self::BadAcceleration => warning::mjWARN_BADQACC,
            Self::BadControl => warning::mjWARN_BADCTRL,
        }) as usize
    }
}

/// Largest position that MuJoCo steps from (`mjMAXVAL`).
const MAX_POSITION: f64 = 1e10;

/// Statistics of a warning since the last reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WarningStat {
    /// Number of occurrences.
    pub count: usize,
    /// MuJoCo's detail of the last occurrence: an index for the `Bad…` warnings, a size for the `…Full` warnings.
    pub last_info: i32,
}

impl Data {
    /// Creates a simulation in the model's initial state.
    ///
    /// # Errors
    /// [`Error::Raised`] if MuJoCo cannot allocate it.
    pub fn new(model: impl Into<Arc<Model>>) -> Result<Self, Error> {
        check_library()?;
        let model = model.into();
        let mut pointer = ptr::null_mut();
        // SAFETY: reads a valid model and writes the pointer of a new mjData, initialized and zeroed.
        guarded("mj_makeData", unsafe { mujoco_sys::mjshim_make_data(model.as_ptr(), &mut pointer) })?;
        let pointer = NonNull::new(pointer)
            .ok_or_else(|| Error::Raised { call: "mj_makeData", message: "no memory for the simulation".into() })?;
        Ok(Self { pointer, model, step_contacts: 0, broken: None })
    }

    /// Returns the simulated model.
    #[inline]
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Returns mutable access to the numbers of the simulated model; changes take effect from the next step. A
    /// shared model is copied first.
    ///
    /// # Errors
    /// [`Error::Raised`] if MuJoCo cannot allocate the copy.
    pub fn patch_model(&mut self) -> Result<ModelMut<'_>, Error> {
        if Arc::get_mut(&mut self.model).is_none() {
            self.model = Arc::new(self.model.try_clone()?);
        }
        // a copy has the same structure, so that this simulation's memory fits it
        Arc::get_mut(&mut self.model)
            .map(Model::patch)
            .ok_or_else(|| Error::Raised { call: "mj_copyModel", message: "the model is shared".into() })
    }

    /// Returns the model, to be shared with another simulation.
    pub fn shared_model(&self) -> Arc<Model> {
        Arc::clone(&self.model)
    }

    /// Advances the simulation by one time step.
    ///
    /// # Errors
    /// - [`Error::Diverged`] if the state became non-finite or too large: MuJoCo has then reset the simulation to
    ///   the model's initial state (and may have advanced it by one step since).
    /// - [`Error::Raised`] with MuJoCo's message for its other errors: the simulation must be [reset](Self::reset).
    /// - [`Error::Value`] if the pose of a mocap body is not finite.
    pub fn step(&mut self) -> Result<(), Error> {
        self.usable()?;
        self.mocap_bounded()?;
        let time = self.raw().time;
        // MuJoCo updates the maximum whenever it adds a contact, so that it is that of this step
        let before = std::mem::take(&mut self.raw_mut().maxuse_con);
        // SAFETY: model and data belong together and are valid; no Rust frame lies below the shim's guard.
        let status = unsafe { mujoco_sys::mjshim_step(self.model.as_ptr(), self.pointer.as_ptr()) };
        self.step_contacts = self.raw().maxuse_con;
        self.raw_mut().maxuse_con = self.step_contacts.max(before);
        if status != 0 {
            return Err(self.fault("mj_step", status));
        }
        self.divergence(time)
    }

    /// Computes all quantities that follow from the state, up to the accelerations, without advancing time.
    ///
    /// # Errors
    /// [`Error::Diverged`] if positions (`qpos`) are not finite or exceed 1e10: nothing is computed, and nothing is
    /// reset. Non-finite velocities and forces propagate to the results. Otherwise as for [`step`](Self::step).
    pub fn forward(&mut self) -> Result<(), Error> {
        self.usable()?;
        self.mocap_bounded()?;
        self.bounded(self.qpos())?;
        // SAFETY: as for `step`.
        let status = unsafe { mujoco_sys::mjshim_forward(self.model.as_ptr(), self.pointer.as_ptr()) };
        self.step_contacts = 0;
        if status != 0 { Err(self.fault("mj_forward", status)) } else { Ok(()) }
    }

    /// Computes the poses of bodies, geoms, sites, cameras and lights only.
    ///
    /// # Errors
    /// As for [`forward`](Self::forward).
    pub fn kinematics(&mut self) -> Result<(), Error> {
        self.usable()?;
        self.mocap_bounded()?;
        self.bounded(self.qpos())?;
        // SAFETY: as for `step`.
        let status = unsafe { mujoco_sys::mjshim_kinematics(self.model.as_ptr(), self.pointer.as_ptr()) };
        if status != 0 { Err(self.fault("mj_kinematics", status)) } else { Ok(()) }
    }

    /// Resets the simulation to the model's initial state, time 0, no warnings, no applied forces.
    ///
    /// # Errors
    /// [`Error::Raised`] with MuJoCo's message.
    pub fn reset(&mut self) -> Result<(), Error> {
        // SAFETY: as for `step`; a reset also empties MuJoCo's stack.
        let status = unsafe { mujoco_sys::mjshim_reset(self.model.as_ptr(), self.pointer.as_ptr()) };
        guarded("mj_resetData", status)?;
        (self.broken, self.step_contacts) = (None, 0);
        Ok(())
    }

    /// Resets the simulation except for its state: time 0, no applied forces and controls, no warm start of the
    /// solver, no contacts and no warnings.
    ///
    /// The caller then writes `qpos`, `qvel` and the other inputs of the model. This is faster than
    /// [`reset`](Self::reset), which also clears buffers that the next step or forward pass recomputes.
    ///
    /// # Errors
    /// [`Error::Raised`] if a [`reset`](Self::reset), which this does after an error, fails.
    pub fn rewind(&mut self) -> Result<(), Error> {
        if self.broken.is_some() {
            self.reset()?;
        }
        self.qacc_warmstart_mut().fill(0.0);
        self.xfrc_applied_mut().fill(0.0);
        self.qfrc_applied_mut().fill(0.0);
        self.ctrl_mut().fill(0.0);
        let raw = self.raw_mut();
        raw.time = 0.0;
        (raw.ncon, raw.nefc, raw.ne, raw.nf) = (0, 0, 0, 0);
        self.step_contacts = 0;
        let raw = self.raw_mut();
        for warning in &mut raw.warning {
            (warning.number, warning.lastinfo) = (0, 0);
        }
        Ok(())
    }

    /// Returns true if an error has made the simulation unusable until a [reset](Self::reset).
    pub fn is_broken(&self) -> bool {
        self.broken.is_some()
    }

    /// Returns the simulated time, s.
    #[inline]
    pub fn time(&self) -> f64 {
        self.raw().time
    }

    /// Sets the position of a geom in the world frame, m, until the next [`kinematics`](Self::kinematics) or step;
    /// for rays and images.
    ///
    /// # Errors
    /// [`Error::NotOfModel`]; [`Error::Value`] if a coordinate is not finite or exceeds 1e10.
    pub fn set_geom_xpos(&mut self, geom: GeomId, position: [f64; 3]) -> Result<(), Error> {
        let count = self.model().ngeom();
        if geom.index() >= count {
            return Err(Error::NotOfModel { kind: GeomId::KIND, index: geom.index(), count });
        }
        crate::limits::position(&position)?;
        // SAFETY: the numbers are finite and within MuJoCo's range; the index is below the model's number of geoms.
        let places = unsafe { self.geom_xpos_mut() };
        places[3 * geom.index()..][..3].copy_from_slice(&position);
        Ok(())
    }

    /// Sets the simulated time, s.
    pub fn set_time(&mut self, time: f64) {
        self.raw_mut().time = time;
    }

    /// Returns the contacts found in the last step or forward pass. A step of several stages (RK4) has those of its
    /// last stage.
    pub fn contacts(&self) -> impl ExactSizeIterator<Item = Contact<'_>> {
        self.first_contacts(self.raw().ncon)
    }

    /// Returns the contacts found in the last step, in all its stages: those of the last stage, and those of earlier
    /// stages that the last one has not overwritten. The list is empty only if no stage had a contact. After a forward
    /// pass, it is that of [`contacts`](Self::contacts).
    ///
    /// ```
    /// use mujoco_rs::{Data, Model};
    ///
    /// let model = Model::from_xml(
    ///     "<mujoco><option timestep='.002' integrator='RK4'/><worldbody><geom type='plane' size='1 1 1'/>
    ///     <body pos='0 0 .1'><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
    /// )?;
    /// let mut data = Data::new(model)?;
    /// data.step()?;
    /// assert!(data.contacts_in_step().len() >= data.contacts().len());
    /// # Ok::<(), mujoco_rs::Error>(())
    /// ```
    pub fn contacts_in_step(&self) -> impl ExactSizeIterator<Item = Contact<'_>> {
        self.first_contacts(self.raw().ncon.max(self.step_contacts))
    }

    /// Returns the first contacts of MuJoCo's list, of which at least `count` have been filled.
    fn first_contacts(&self, count: i32) -> impl ExactSizeIterator<Item = Contact<'_>> {
        let raw = self.raw();
        let found = usize::try_from(count).unwrap_or(0).min(self.model.nconmax());
        let contacts: &[mujoco_sys::mjContact] = if found == 0 {
            &[]
        } else {
            // SAFETY: MuJoCo allocated nconmax contacts and has filled the first ones, as many as the caller says.
            unsafe { std::slice::from_raw_parts(raw.contact, found) }
        };
        contacts.iter().map(Contact)
    }

    /// Returns the statistics of a warning since the last reset. Warnings of a diverged state are not counted: the
    /// step that raised them returned them as errors.
    pub fn warning(&self, kind: WarningKind) -> WarningStat {
        let stat = &self.raw().warning[kind.index()];
        WarningStat { count: usize::try_from(stat.number).unwrap_or(0), last_info: stat.lastinfo }
    }

    /// Returns the largest use of MuJoCo's stack so far, in numbers; the model's `nstack` is the limit.
    pub fn max_stack_used(&self) -> usize {
        usize::try_from(self.raw().maxuse_stack).unwrap_or(0)
    }

    /// Returns the largest number of contacts so far; the model's `nconmax` is the limit.
    pub fn max_contacts_used(&self) -> usize {
        usize::try_from(self.raw().maxuse_con).unwrap_or(0)
    }

    /// Returns the largest number of scalar constraints so far; the model's `njmax` is the limit.
    pub fn max_constraints_used(&self) -> usize {
        usize::try_from(self.raw().maxuse_efc).unwrap_or(0)
    }

    /// Returns the size of this simulation's buffers, bytes.
    pub fn bytes(&self) -> usize {
        let raw = self.raw();
        usize::try_from(raw.nbuffer).unwrap_or(0) + usize::try_from(raw.nstack).unwrap_or(0) * size_of::<f64>()
    }

    /// Returns the first geom that a ray hits and its distance in multiples of `direction`, by MuJoCo's `mj_ray`;
    /// `None` if the ray hits nothing.
    ///
    /// `origin` and `direction` are in the world frame. `groups` selects the visible geom groups, of six. Geoms of
    /// body `exclude` are ignored.
    ///
    /// # Errors
    /// [`Error::Raised`] with MuJoCo's message; [`Error::Value`] for a direction of length zero or non-finite
    /// numbers.
    pub fn ray(
        &self,
        origin: [f64; 3],
        direction: [f64; 3],
        groups: [bool; 6],
        exclude: Option<crate::BodyId>,
    ) -> Result<Option<(GeomId, f64)>, Error> {
        if let Some(&got) = origin.iter().chain(&direction).find(|value| !value.is_finite()) {
            return Err(Error::Value { what: "a ray's coordinate", got, expected: "a finite number" });
        }
        if direction.iter().all(|&value| value.abs() < 1e-12) {
            return Err(Error::Value { what: "a ray's length", got: 0.0, expected: "a direction" });
        }
        let groups = groups.map(u8::from);
        let mut geom = -1;
        let mut distance = -1.0;
        let exclude = exclude.map_or(-1, |body| body.index() as i32);
        // SAFETY: model and data belong together; `mj_ray` reads them and writes the two results.
        let status = unsafe {
            mujoco_sys::mjshim_ray(
                self.model.as_ptr(),
                self.pointer.as_ptr(),
                origin.as_ptr(),
                direction.as_ptr(),
                groups.as_ptr(),
                1,
                exclude,
                &mut geom,
                &mut distance,
            )
        };
        guarded("mj_ray", status)?;
        Ok(usize::try_from(geom).ok().map(|geom| (GeomId::new(geom), distance)))
    }

    fn usable(&self) -> Result<(), Error> {
        match &self.broken {
            None => Ok(()),
            Some(error) => Err(error.clone()),
        }
    }

    #[cold]
    fn fault(&mut self, call: &'static str, status: i32) -> Error {
        let error = match guarded(call, status) {
            Err(error) => error,
            Ok(()) => Error::Raised { call, message: String::new() },
        };
        if was_raised(status) {
            self.broken = Some(error.clone());
        }
        error
    }

    /// Rejects positions outside the range of MuJoCo's collision detection. `mj_step` checks `qpos` itself; no
    /// MuJoCo function checks the mocap bodies.
    #[inline]
    fn bounded(&self, positions: &[f64]) -> Result<(), Error> {
        let within = |value: &f64| value.abs() <= MAX_POSITION;
        match positions.iter().position(|value| !within(value)) {
            None => Ok(()),
            Some(index) => {
                Err(Error::Diverged(Divergence { quantity: DivergedQuantity::Position, index, time: self.time() }))
            }
        }
    }

    #[inline]
    fn mocap_bounded(&self) -> Result<(), Error> {
        match self
            .mocap_pos()
            .iter()
            .chain(self.mocap_quat())
            .find(|value| value.is_nan() || value.abs() > MAX_POSITION)
        {
            None => Ok(()),
            Some(&got) => Err(Error::Value {
                what: "the position or orientation of a mocap body",
                got,
                expected: "finite numbers of at most 1e10",
            }),
        }
    }

    /// Returns an error if the step diverged: MuJoCo resets a diverged simulation and only counts a warning.
    #[inline]
    fn divergence(&mut self, time: f64) -> Result<(), Error> {
        let kinds = [
            (WarningKind::BadPosition, DivergedQuantity::Position),
            (WarningKind::BadVelocity, DivergedQuantity::Velocity),
            (WarningKind::BadAcceleration, DivergedQuantity::Acceleration),
        ];
        for (kind, quantity) in kinds {
            let stat = &mut self.raw_mut().warning[kind.index()];
            if stat.number > 0 {
                stat.number = 0;
                let index = usize::try_from(stat.lastinfo).unwrap_or(0);
                return Err(Error::Diverged(Divergence { quantity, index, time }));
            }
        }
        Ok(())
    }

    pub(crate) fn as_ptr(&mut self) -> *mut mujoco_sys::mjData {
        self.pointer.as_ptr()
    }

    #[inline]
    pub(crate) fn raw(&self) -> &mujoco_sys::mjData {
        // SAFETY: valid from construction to drop.
        unsafe { self.pointer.as_ref() }
    }

    #[inline]
    fn raw_mut(&mut self) -> &mut mujoco_sys::mjData {
        // SAFETY: as above, and borrowed mutably.
        unsafe { self.pointer.as_mut() }
    }
}

impl Drop for Data {
    fn drop(&mut self) {
        // SAFETY: allocated by MuJoCo, freed once.
        unsafe { mujoco_sys::mj_deleteData(self.pointer.as_ptr()) };
    }
}

impl fmt::Debug for Data {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Data").field("time", &self.time()).field("model", &self.model).finish_non_exhaustive()
    }
}

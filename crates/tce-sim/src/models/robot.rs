//! The description of a robot: a tree of bodies with joints, geoms and motors. SI units; angles in radians.

/// A point or direction in a body's frame.
pub type Vec3 = [f64; 3];

/// MuJoCo's time integration methods.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Integrator {
    /// Semi-implicit Euler.
    Euler,
    /// Fourth-order Runge-Kutta.
    Rk4,
}

/// A complete robot on a floor.
#[derive(Clone, Debug, PartialEq)]
pub struct Robot {
    /// Name of the MuJoCo model.
    pub name: String,
    /// Time integration.
    pub integrator: Integrator,
    /// Integration step h, seconds.
    pub timestep: f64,
    /// Gravitational acceleration along z, m/s^2 (negative: downwards).
    pub gravity: f64,
    /// Mass density of every geom, kg/m^3.
    pub density: f64,
    /// If set, all masses and inertias are scaled so that the robot has this total mass, kg.
    pub total_mass: Option<f64>,
    /// Contact properties of every geom.
    pub contact: Contact,
    /// Solver parameters (solimp, solref) of the joint limits, if they differ from MuJoCo's defaults.
    pub limit_solver: Option<([f64; 3], [f64; 2])>,
    /// The root of the tree.
    pub torso: Body,
    /// The motors, in the order of the action's components.
    pub motors: Vec<Motor>,
}

/// Contact properties of all geoms of a robot. They also apply to the floor, except `between_bodies` and `condim`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Whether the robot's geoms can also touch each other, not only the floor.
    pub between_bodies: bool,
    /// Contact dimensions of the robot's geoms (1: frictionless, 3: sliding friction); the floor always has 3.
    pub condim: u32,
    /// Distance at which a contact becomes active, m. The value is that of the original environments, for a MuJoCo
    /// version that uses the *larger* margin of two geoms.
    pub margin: f64,
    /// Sliding, torsional and rolling friction. A geom may override the sliding friction.
    pub friction: [f64; 3],
    /// Solver parameters (solimp, solref), if they differ from MuJoCo's defaults.
    pub solver: Option<([f64; 3], [f64; 2])>,
}

/// A rigid body and its child bodies.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// Unique name.
    pub name: String,
    /// Origin in the parent's frame, m.
    pub position: Vec3,
    /// Degrees of freedom relative to the parent; empty if it is welded to the parent.
    pub joints: Vec<Joint>,
    /// Shapes.
    pub geoms: Vec<Geom>,
    /// Child bodies.
    pub children: Vec<Body>,
}

/// Kinds of joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// Six degrees of freedom.
    Free,
    /// Translation along the axis.
    Slide,
    /// Rotation about the axis.
    Hinge,
}

/// A joint.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Unique name.
    pub name: String,
    /// Kind.
    pub kind: JointKind,
    /// Axis in the body's frame.
    pub axis: Vec3,
    /// Position in the body's frame, m.
    pub position: Vec3,
    /// The coordinate's value in the model's rest configuration.
    pub reference: f64,
    /// Limits of the coordinate, rad; `None`: unlimited.
    pub range: Option<[f64; 2]>,
    /// Rotor inertia added to the joint's inertia.
    pub armature: f64,
    /// Viscous damping.
    pub damping: f64,
    /// Spring stiffness.
    pub stiffness: f64,
}

/// Shapes of geoms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A sphere at the body's origin.
    Sphere,
    /// A capsule between two points (the centres of its caps).
    Segment {
        /// One end, m.
        from: Vec3,
        /// The other end, m.
        to: Vec3,
    },
    /// A capsule given by its centre and the rotation of its axis from z about y.
    Tilted {
        /// Centre, m.
        centre: Vec3,
        /// Half the length of the cylindrical part, m.
        half_length: f64,
        /// Angle about y, rad.
        tilt: f64,
    },
}

/// A shape with a radius.
#[derive(Clone, Debug, PartialEq)]
pub struct Geom {
    /// Unique name.
    pub name: String,
    /// Radius, m.
    pub radius: f64,
    /// Shape and placement.
    pub shape: Shape,
    /// Sliding friction, if it differs from the robot's.
    pub sliding_friction: Option<f64>,
}

/// A torque motor with control range [-1, 1].
#[derive(Clone, Debug, PartialEq)]
pub struct Motor {
    /// The joint it drives (also its name).
    pub joint: String,
    /// Torque at control 1, N m.
    pub gear: f64,
}

impl Body {
    /// A body with one geom of the same name, without joints and children.
    pub fn new(name: &str, position: Vec3, geom: Geom) -> Self {
        Self { name: name.to_owned(), position, joints: Vec::new(), geoms: vec![geom], children: Vec::new() }
    }

    /// Adds a joint.
    pub fn joint(mut self, joint: Joint) -> Self {
        self.joints.push(joint);
        self
    }

    /// Adds a child body.
    pub fn child(mut self, child: Body) -> Self {
        self.children.push(child);
        self
    }

    /// The body of that name in this subtree.
    fn find(&mut self, name: &str) -> Option<&mut Body> {
        if self.name == name {
            return Some(self);
        }
        self.children.iter_mut().find_map(|c| c.find(name))
    }

    /// Visits this body and all below it, parents first.
    pub fn visit<'a>(&'a self, f: &mut impl FnMut(&'a Body)) {
        f(self);
        for child in &self.children {
            child.visit(f);
        }
    }
}

impl Joint {
    /// An unlimited joint without armature, damping and stiffness.
    pub fn free_moving(name: &str, kind: JointKind, axis: Vec3) -> Self {
        Self {
            name: name.to_owned(),
            kind,
            axis,
            position: [0.0; 3],
            reference: 0.0,
            range: None,
            armature: 0.0,
            damping: 0.0,
            stiffness: 0.0,
        }
    }

    /// A hinge with limits, rad.
    pub fn hinge(name: &str, axis: Vec3, range: [f64; 2], armature: f64, damping: f64) -> Self {
        Self { range: Some(range), armature, damping, ..Self::free_moving(name, JointKind::Hinge, axis) }
    }
}

impl Geom {
    /// A capsule of the given `radius` from `from` to `to`.
    pub fn segment(name: &str, radius: f64, from: Vec3, to: Vec3) -> Self {
        Self { name: name.to_owned(), radius, shape: Shape::Segment { from, to }, sliding_friction: None }
    }

    /// A capsule with the given `centre`, its axis rotated by `tilt` about y.
    pub fn tilted(name: &str, radius: f64, half_length: f64, centre: Vec3, tilt: f64) -> Self {
        let shape = Shape::Tilted { centre, half_length, tilt };
        Self { name: name.to_owned(), radius, shape, sliding_friction: None }
    }

    /// Sets the geom's own sliding friction.
    pub fn friction(mut self, sliding: f64) -> Self {
        self.sliding_friction = Some(sliding);
        self
    }
}

impl Robot {
    /// The body of that name.
    ///
    /// # Panics
    /// If there is no such body: names are constants of this crate.
    pub fn body_mut(&mut self, name: &str) -> &mut Body {
        self.torso.find(name).unwrap_or_else(|| panic!("no body named {name}"))
    }

    /// The limits of the joint `name` in the body of the same name.
    ///
    /// # Panics
    /// If there is no such body, or its joint has another name.
    pub fn range_mut(&mut self, name: &str) -> &mut Option<[f64; 2]> {
        let joint = self.body_mut(name).joints.iter_mut().find(|j| j.name == name);
        &mut joint.unwrap_or_else(|| panic!("body {name} has no joint {name}")).range
    }

    /// The first geom of the given body.
    ///
    /// # Panics
    /// If there is no such body.
    pub fn geom_mut(&mut self, body: &str) -> &mut Geom {
        &mut self.body_mut(body).geoms[0]
    }
}

//! A quadrotor that stands in for hardware: equations and integrator of its own, written apart from the models, so that
//! nothing that is identified from it meets its own formulas again.

/// Counts of the motor signal that carry this mass at rest, kg.
pub fn hover(mass: f64) -> f64 {
    mass * 9.81 / (2.89e-7 + 1.43e-4 / 15.47)
}

/// What is its own; the motors' constants are those of every Crazyflie 2.0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Airframe {
    /// Mass, kg.
    pub mass: f64,
    /// Rate at which roll and pitch follow their references, 1/s.
    pub attitude_rate: f64,
    /// Drag across and along the rotors' axis, N s²/(m rad).
    pub drag: [f64; 2],
}

/// How it moves; its yaw is zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Flight {
    /// x, y, z, m.
    pub position: [f64; 3],
    /// Along x, y, z, m/s.
    pub velocity: [f64; 3],
    /// Roll, rad.
    pub roll: f64,
    /// Pitch, rad.
    pub pitch: f64,
    /// What the motors do, counts s.
    pub motors: f64,
}

impl Flight {
    /// At rest at a place, the motors carrying a Crazyflie of 30 g.
    pub fn hovering(position: [f64; 3]) -> Self {
        Self { position, motors: hover(0.03) / 15.47, ..Self::default() }
    }

    /// Further along a slope for a time.
    #[must_use]
    pub fn along(self, slope: Self, h: f64) -> Self {
        let further = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|k| a[k] + h * b[k]);
        Self {
            position: further(self.position, slope.position),
            velocity: further(self.velocity, slope.velocity),
            roll: self.roll + h * slope.roll,
            pitch: self.pitch + h * slope.pitch,
            motors: self.motors + h * slope.motors,
        }
    }
}

impl Airframe {
    fn slope(&self, x: &Flight, [pwm, roll, pitch]: [f64; 3]) -> Flight {
        let thrust = 1.43e-4 * x.motors + 2.89e-7 * pwm;
        let (a, b, c) = (2.13e-11, 1.03e-6, 5.49e-4 - thrust / 4.0);
        let effective = ((b * b - 4.0 * a * c).max(0.0).sqrt() - b) / (2.0 * a);
        let rotors = 4.0 * (0.041 * effective + 380.83);
        // The body's axes in the world.
        let ((sr, cr), (sp, cp)) = (x.roll.sin_cos(), x.pitch.sin_cos());
        let axes = [[cp, 0.0, -sp], [sp * sr, cr, cp * sr], [sp * cr, -sr, cp * cr]];
        let mut force = [0.0; 3];
        for (k, axis) in axes.iter().enumerate() {
            let speed: f64 = (0..3).map(|i| axis[i] * x.velocity[i]).sum();
            let along = if k == 2 { thrust } else { 0.0 } - self.drag[usize::from(k == 2)] * rotors * speed;
            (0..3).for_each(|i| force[i] += axis[i] * along);
        }
        Flight {
            position: x.velocity,
            velocity: [force[0] / self.mass, force[1] / self.mass, force[2] / self.mass - 9.81],
            roll: self.attitude_rate * (roll - x.roll),
            pitch: self.attitude_rate * (pitch - x.pitch),
            motors: -15.47 * x.motors + pwm,
        }
    }

    /// After `h` seconds under motor signal (counts), roll and pitch references (rad): the midpoint rule.
    #[must_use]
    pub fn step(&self, x: Flight, command: [f64; 3], h: f64) -> Flight {
        let middle = x.along(self.slope(&x, command), 0.5 * h);
        x.along(self.slope(&middle, command), h)
    }
}

"""The effects by key. A new one: a class in its group's file and a line here."""

from data.registry import Registry

EFFECTS = Registry(
    "effect",
    {
        "floor_sink": "twin.plants.effects.heat:FloorSink",
        "cabinet_heat": "twin.plants.effects.heat:CabinetHeat",
        "pump_heat": "twin.plants.effects.heat:PumpHeat",
        "guide_friction": "twin.plants.effects.heat:GuideFriction",
        "sun": "twin.plants.effects.heat:Sun",
        "unlisted_warm_speed": "twin.plants.effects.heat:UnlistedWarmSpeed",
        "unlisted_coolant_speed": "twin.plants.effects.heat:UnlistedCoolantSpeed",
        "unlisted_feed_speed": "twin.plants.effects.heat:UnlistedFeedSpeed",
        "radiation": "twin.plants.effects.surfaces:Radiation",
        "rotating_convection": "twin.plants.effects.surfaces:RotatingConvection",
        "natural_convection": "twin.plants.effects.surfaces:NaturalConvection",
        "draught": "twin.plants.effects.surfaces:Draught",
        "stratification": "twin.plants.effects.surfaces:Stratification",
        "viscosity_feedback": "twin.plants.effects.bearings:ViscosityFeedback",
        "preload_feedback": "twin.plants.effects.bearings:PreloadFeedback",
        "speed_shift": "twin.plants.effects.shown:SpeedShift",
        "sensor_drift": "twin.plants.effects.shown:SensorDrift",
        "sensor_lag": "twin.plants.effects.shown:SensorLag",
        "sensor_swap": "twin.plants.effects.shown:SensorSwap",
        "time_skew": "twin.plants.effects.shown:TimeSkew",
        "wrong_parameter": "twin.plants.effects.shown:WrongParameter",
        "motor_loss": "twin.plants.effects.withheld:MotorLoss",
        "column_bending": "twin.plants.effects.withheld:ColumnBending",
        "spindle_growth": "twin.plants.effects.withheld:SpindleGrowth",
        "mandrel": "twin.plants.effects.withheld:Mandrel",
    },
)

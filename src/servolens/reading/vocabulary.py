"""The vocabulary of headings: words, symbols and units for an axis's signals, in five languages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "AMOUNTS",
    "ANGLES",
    "ASKED_LETTERS",
    "ASSUMED",
    "CALCULATED",
    "COMMANDS",
    "IMPLIED",
    "LAWS",
    "LETTERS",
    "LETTER_KINDS",
    "MEASURED_LETTERS",
    "MOTOR_VOLTAGES",
    "OF_ERRORS",
    "PLACES",
    "ROMANCE",
    "SENSORS",
    "SHAPED",
    "SPANS",
    "UNITS",
    "WORDS",
]

_COMMON: Mapping[str, str] = {
    "time": (
        "time times t zeit timestamp timestamps zeitstempel stempel stamp clock uhrzeit elapsed ts millis micros "
        "nanos datetime secs temps"
    ),
    "position": (
        "position positions positionen pos lage weg ort encoder enc geber displacement verschiebung stellung "
        "hub strecke travel distance distanz abstand carriage coordinate koordinate xpos ypos fpos "
    ),
    "angle": (
        "angle angles angular ang rotary rotational winkel rotation drehwinkel heading azimuth azimut elevation pitch "
        "yaw roll"
    ),
    "velocity": (
        "velocity velocities vel velo speed geschwindigkeit drehzahl omega rpm rate thetadot phidot qdot "
        "xdot dot dq tacho gyro gyroscope"
    ),
    "pace": "tempo",
    "voltage": "voltage vq uq volt volts spannung vir vm uout umot umotor vmotor uanker ustell",
    "tension": "tension",
    "duty": "duty pwm dutycycle tastverhaeltnis tastgrad aussteuerung",
    "current": "strom amps ampere iq",
    "torque": "torque trq tau moment momenten drehmoment drehmomenten effort couple",
    "force": "force kraft thrust",
    "output": (
        "u output out op co dac stellgroesse stellsignal stellwert ausgang control actuation manipulated motorcommand"
    ),
    "either": "command cmd commanded",
    "input": "input eingang",
    "reference": (
        "reference references ref refs setpoint setpoints sp soll sollwert sollwerte target targets zielwert "
        "ziel desired des goal demand demanded wanted fuehrung fuehrungsgroesse trajectory vorgabe nominal "
        "leitwert set action rpos traj plan planned planner"
    ),
    "actual": (
        "actual act pv ist istwert istwerte measured measurement meas feedback fbk fb present estimate estimated "
        "est sensor real mess messwert gemessen response regelgroesse observation state "
        "reelle reale"
    ),
    "feedforward": "feedforward ff vorsteuerung",
    "direction": "dir direction richtung drehrichtung vorzeichen",
    "enabled": "enabled enable freigabe",
    "error": "error err e abweichung deviation regelabweichung regeldifferenz schleppfehler schleppabstand fehler",
    "other": (
        "following lag delta diff difference differenz alimentation alimentazione alimentacion "
        "temperature temp temperatur bus vbus supply versorgung zwischenkreis dc battery "
        "batterie netz betrieb speise bord vorspannung zugspannung riemenspannung federspannung "
        "vbat bat akku input_voltage id mode modus status fault faults flag flags warning acc accel "
        "acceleration beschleunigung jerk ruck power leistung energy limit grenze max min kp ki kd gain pgain "
        "igain dgain moving index counter zaehler count_no seq sequence frame episode task trial "
        "ref_count crc checksum checks id_current integral integrator p_term i_term d_term anteil pressure "
        "druck flow durchfluss frequency frequenz freq weight gewicht mass masse mag magnetometer electrical elec "
        "elektrisch elektrische elektrischer vd ud nr lfdnr row zeile rssi line note comment kommentar bemerkung offset"
    ),
    "neutral": (
        "value wert signal data daten raw filtered filt joint joints gelenk axis achse motor servo drive antrieb "
        "antriebs controller regler the of der des regel raum cart wagen schlitten arm link spindle spindel actual_ in "
        "me mess field msg val var main gvl plc prg act_ r4 f fl lr nc tonc plctonc nctoplc axes stage table "
        "tisch"
        " axe asse eje de del di du della chariot carrello carro"
        " achs achsen kolben zylinder ventil greifer vorschub kran katz spindel tisch stoessel wellen kreuz roboter"
    ),
}
_ROMANCE: Mapping[str, str] = {
    "time": "tiempo horodatage",
    "position": "posizione posicion posicao deplacement spostamento desplazamiento",
    "angle": "angolo angulo",
    "velocity": "vitesse velocita velocidad velocidade",
    "voltage": "voltaje",
    "tension": "tensione tensao",
    "current": "courant corrente corriente",
    "torque": "coppia",
    "force": "forza fuerza",
    "either": "commande comando mando",
    "reference": "consigne riferimento referencia consigna desiderata desiderato deseada deseado desiree desejada",
    "actual": "mesure mesuree misura misurata misurato medida medido",
    "error": "erreur ecart errore",
    "neutral": "moteur motore",
}
ROMANCE = frozenset(" ".join(_ROMANCE.values()).split())
"""Words that tell French, Italian and Spanish: beside one "tension" is a voltage, not a pull."""
WORDS: Mapping[str, str] = {kind: f"{words} {_ROMANCE.get(kind, '')}" for kind, words in _COMMON.items()}
"""Words by what they say."""
OF_ERRORS = frozenset({"following", "lag", "tracking", "control", "suivi", "poursuite", "inseguimento", "seguimiento"})
"""What stands beside the word for an error where that is the loop's: reference less position."""
LETTERS: Mapping[str, tuple[str, ...]] = {
    "r": ("reference",),
    "w": ("reference", "velocity"),
    "y": ("position",),
    "x": ("position",),
    "z": ("position",),
    "theta": ("position",),
    "phi": ("position",),
    "psi": ("position",),
    "alpha": ("position",),
    "q": ("position",),
    "v": ("velocity", "voltage"),
    "i": ("voltage",),
    "ua": ("voltage",),
    "qm": ("position",),
    "qg": ("reference",),
    **dict.fromkeys(("qd", "xd", "yd", "thetad", "phid"), ("reference", "velocity")),
}
"""Symbols that stand alone; of two meanings the data or the other columns must decide."""
ANGLES = frozenset({"theta", "phi", "psi", "alpha", "thetad", "phid"})
PLACES = ("x", "y", "z", "q", "theta", "phi", "psi", "alpha")
"""Symbols of positions, to which names append what is asked of them: xref, theta_des, qSoll."""
LETTER_KINDS = {"i": "current", "ua": "voltage"}
"""Kind of the command that a symbol stands for."""
MOTOR_VOLTAGES = frozenset(
    (
        *(
            "stell",
            "ventil",
            "anker",
            "klemmen",
            "steuer",
            "ansteuer",
            "ansteuerungs",
            "regel",
            "motoren",
            "aktor",
            "aktuator",
        ),
        *("umrichter", "verstaerker", "treiber", "endstufen", "spulen"),
    )
)
"""What stands before "spannung" where that is the command, beside the words that are known."""
MEASURED_LETTERS: Mapping[str, tuple[str, ...]] = {
    "i": ("voltage",),
    "n": ("velocity",),
    "w": ("velocity",),
    "v": ("velocity", "voltage"),
    "m": (),
    "f": (),
}
"""What symbols of no position mean beside "actual": ``n_ist`` is a speed, ``M_ist`` a torque or a mass."""
ASKED_LETTERS: Mapping[str, tuple[str, ...]] = {
    **MEASURED_LETTERS,
    "n": (),
    "v": (),
    "w": ("reference", "velocity"),
}
"""The same beside "reference": ``v_soll`` is a trajectory's speed or a drive's command, which only its owner knows."""
LAWS = frozenset({"controller", "regler", "pid", "pi", "pd", "ctrl"})
"""Words that make an output the controller's, whatever it controls: ``pos_pid_out``."""
SENSORS = frozenset(
    {"sensor", "sensors", "pot", "poti", "potentiometer", "potmeter", "tacho", "lvdt", "geber", "transducer"}
)
"""Words that make a voltage a reading, not a command."""
SHAPED = frozenset({"limited", "profiled"})
"""Words that make a position the one that the path generator asks for: Copley's "Limited Position"."""
SPANS = frozenset(
    {
        "cycle",
        "loop",
        "zyklus",
        "exec",
        "execution",
        "compute",
        "calc",
        "latency",
        "jitter",
        "period",
        "task",
        "reponse",
        "ciclo",
    }
)
"""Words that make a time one that something takes."""
CALCULATED = frozenset(
    {"sim", "simulated", "simulation", "simuliert", "model", "modell", "modelled", "predicted", "prediction", "hat"}
)
"""Words for what was calculated, where it was measured as well."""
AMOUNTS = frozenset({"load", "last"})
"""Words for what is measured or asked for where no word says position: ``Present_Load``."""
COMMANDS = ("voltage", "duty", "current", "torque", "force", "output")
IMPLIED = {
    "millis": "ms",
    "micros": "us",
    "nanos": "ns",
    "rpm": "rpm",
    "pwm": "pwm",
    "duty": "duty",
    "dutycycle": "duty",
}
ASSUMED = {"current": "A", "torque": "N m", "force": "N"}
UNITS = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "sekunden": "s", "sek": "s",
    "secondes": "s", "secondi": "s", "segundos": "s",
    **dict.fromkeys(("millisecond", "milliseconds", "millisekunden", "millisecondes", "millisecondi"), "ms"),
    **dict.fromkeys(("milisegundos", "milliseconden"), "ms"),
    **dict.fromkeys(("microseconds", "mikrosekunden", "microsecondes"), "us"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetern", "millimetre", "millimetres", "millimetri"), "mm"),
    **dict.fromkeys(("milimetros", "milimetro", "millimetro"), "mm"),
    **dict.fromkeys(("micrometer", "micrometers", "micrometre", "micrometres", "mikrometer"), "um"),
    **dict.fromkeys(("micron", "microns"), "um"),
    **dict.fromkeys(("centimeter", "centimeters", "centimetre", "centimetres", "zentimeter"), "cm"),
    **dict.fromkeys(("metre", "metres", "metern", "metri", "metros"), "m"),
    **dict.fromkeys(("degres", "gradi", "grados"), "deg"), **dict.fromkeys(("tours", "giri", "vueltas"), "rev"),
    **dict.fromkeys(("radian", "radians", "radiant"), "rad"), "ms": "ms", "msec": "ms",
    "us": "us", "usec": "us", "ns": "ns", "nsec": "ns", "m": "m", "mm": "mm", "um": "um", "cm": "cm", "meter": "m",
    "meters": "m", "rad": "rad", "mrad": "mrad", "deg": "deg", "degs": "deg", "degree": "deg", "degrees": "deg",
    "grad": "deg", "rev": "rev", "revs": "rev", "turn": "rev", "turns": "rev", "rotations": "rev",
    "revolutions": "rev", "umdrehungen": "rev", "umdr": "rev", "umdr.": "rev", "ft": "ft", "feet": "ft",
    "counts": "counts",
    "count": "counts", "cnt": "counts", "cnts": "counts", "ticks": "counts", "inc": "counts", "inkremente": "counts",
    "steps": "counts", "pulse": "counts", "pulses": "counts",
    "impulse": "counts", "v": "V", "volt": "V", "volts": "V", "mv": "mV", "a": "A", "amp": "A", "amps": "A",
    "ampere": "A",
    "inch": "inch", "inches": "inch", "min": "min", "mins": "min", "minutes": "min", "minuten": "min",
    "ma": "mA", "nm": "N m", "mnm": "mN m", "n": "N", "newton": "N", "pct": "%", "percent": "%", "prozent": "%",
    "‰": "0.1%",
    "rpm": "rpm", "dps": "deg/s", "rps": "rev/s", "mps": "m/s", "pwm": "pwm", "duty": "duty",
}  # fmt: skip
"""Units at a heading's end, in small letters."""

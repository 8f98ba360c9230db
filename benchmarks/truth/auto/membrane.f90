! The dielectric elastomer membrane on a chamber of air (Li et al. 2013, doi 10.1016/j.jmps.2012.09.006) for AUTO-07p.
!
! Unknowns U: hoop stretch l2 = r/R, slope theta, meridional stretch l1, volume inside R, and R itself, from START to 1
! while AUTO's T runs from 0 to 1. At START holds the apex series, at the rim the prestretch. With seven conditions the
! last is the gas of the chamber: continuation in q = Phi**2, pressure and apex stretch are free with it. With six there is
! none: continuation in the pressure at fixed q, with the apex stretch free. Dimensionless: lengths in A, pressures in
! mu H/A, volumes in A**3, q in H**2 mu/eps.

MODULE MEMBRANE
  IMPLICIT NONE
  ! places in PAR; BREAKDOWN is (E/E_EB)**2 at the apex
  INTEGER, PARAMETER :: LOAD = 1, PRESSURE = 2, APEX = 3, VOLUME = 4, BREAKDOWN = 5, CHAMBER = 6, FILLING = 7, &
       FILLING_PRESSURE = 8, STRETCH_LIMIT = 9
  DOUBLE PRECISION, PARAMETER :: ATMOSPHERE = 50, PRESTRETCH = 1, START = 1D-3, PI = 3.14159265358979323846D0
  ! sqrt(mu/eps) in MV/m for mu = 45 kPa, eps = 4.7 * 8.854e-12 F/m
  DOUBLE PRECISION, PARAMETER :: FIELD = SQRT(45D3/(4.7D0*8.854D-12))/1D6

CONTAINS

  ! Nominal stresses s1, s2 of a Gent membrane at fixed q, and the derivatives of s1 by l1 and l2
  SUBROUTINE STRESSES(L1, L2, PAR, S1, S2, S11, S12)
    DOUBLE PRECISION, INTENT(IN) :: L1, L2, PAR(*)
    DOUBLE PRECISION, INTENT(OUT) :: S1, S2, S11, S12
    DOUBLE PRECISION Q, J, L3SQ, G, H1, H2
    Q = PAR(LOAD)
    J = PAR(STRETCH_LIMIT)
    L3SQ = 1/(L1*L2)**2
    G = 1 - (L1**2 + L2**2 + L3SQ - 3)/J
    H1 = (L1 - L3SQ/L1)/G
    H2 = (L2 - L3SQ/L2)/G
    S1 = H1 - Q*L1*L2**2
    S2 = H2 - Q*L1**2*L2
    S11 = (1 + 3*L3SQ/L1**2)/G + 2*H1**2/J - Q*L2**2
    S12 = 2*L3SQ/(L1*L2)/G + 2*H1*H2/J - 2*Q*L1*L2
  END SUBROUTINE STRESSES

  ! The state at START from the apex series l1 = la + a R**2, l2 = la + b R**2, theta = kappa R
  SUBROUTINE SERIES(PAR, U)
    DOUBLE PRECISION, INTENT(IN) :: PAR(*)
    DOUBLE PRECISION, INTENT(OUT) :: U(5)
    DOUBLE PRECISION LA, S, S2, S11, S12, KAPPA, A, B
    LA = PAR(APEX)
    CALL STRESSES(LA, LA, PAR, S, S2, S11, S12)
    KAPPA = PAR(PRESSURE)*LA**2/(2*S)
    ! a - 3 b = la kappa**2/2 and a (3 s11 - s12) + b (3 s12 - s11) = -s kappa**2/2
    B = -(S + LA*(3*S11 - S12))*KAPPA**2/(16*S11)
    A = 3*B + LA*KAPPA**2/2
    U(1) = LA + B*START**2
    U(3) = LA + A*START**2
    CALL STRESSES(U(3), U(1), PAR, S, S2, S11, S12)
    U(2) = ASIN(PAR(PRESSURE)*U(1)**2*START/(2*S)) ! the first integral R s1 sin(theta) = p r**2/2
    U(4) = PI/4*LA**3*KAPPA*START**4
    U(5) = START
  END SUBROUTINE SERIES

  ! d(l2, theta, l1, V)/dR
  SUBROUTINE SLOPES(U, PAR, F)
    DOUBLE PRECISION, INTENT(IN) :: U(5), PAR(*)
    DOUBLE PRECISION, INTENT(OUT) :: F(4)
    DOUBLE PRECISION S1, S2, S11, S12, C, S, STRETCHING
    CALL STRESSES(U(3), U(1), PAR, S1, S2, S11, S12)
    C = COS(U(2))
    S = SIN(U(2))
    STRETCHING = U(3)*C - U(1)
    F(1) = STRETCHING/U(5)
    F(2) = -S2/S1*S/U(5) + PAR(PRESSURE)*U(1)*U(3)/S1
    F(3) = (S2*C - S1 - S12*STRETCHING)/(U(5)*S11)
    F(4) = PI*(U(1)*U(5))**2*U(3)*S
  END SUBROUTINE SLOPES

END MODULE MEMBRANE

SUBROUTINE FUNC(NDIM, U, ICP, PAR, IJAC, F, DFDU, DFDP)
  USE MEMBRANE
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM, ICP(*), IJAC
  DOUBLE PRECISION, INTENT(IN) :: U(NDIM), PAR(*)
  DOUBLE PRECISION, INTENT(OUT) :: F(NDIM)
  DOUBLE PRECISION, INTENT(INOUT) :: DFDU(NDIM, *), DFDP(NDIM, *)
  CALL SLOPES(U, PAR, F)
  F(1:4) = (1 - START)*F(1:4)
  F(5) = 1 - START
END SUBROUTINE FUNC

! The state at zero voltage and V_0 = 2.42: integrated from its apex stretch and pressure. AUTO asks for rising T.
SUBROUTINE STPNT(NDIM, U, PAR, T)
  USE MEMBRANE
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM
  DOUBLE PRECISION, INTENT(INOUT) :: U(NDIM), PAR(*)
  DOUBLE PRECISION, INTENT(IN) :: T
  DOUBLE PRECISION, SAVE :: HERE(5)
  DOUBLE PRECISION K1(4), K2(4), K3(4), K4(4), H, R
  PAR(LOAD) = 0
  PAR(PRESSURE) = 1.886612680245D0
  PAR(APEX) = 1.95822343926D0
  PAR(CHAMBER) = 1600
  PAR(FILLING) = 2.42D0
  PAR(FILLING_PRESSURE) = PAR(PRESSURE)
  PAR(STRETCH_LIMIT) = 270
  IF (T == 0) CALL SERIES(PAR, HERE)
  R = START + (1 - START)*T
  DO WHILE (HERE(5) < R)
     H = MIN(HERE(5)/4, 1D-2, R - HERE(5))
     CALL SLOPES(HERE, PAR, K1)
     CALL SLOPES([HERE(1:4) + H/2*K1, HERE(5) + H/2], PAR, K2)
     CALL SLOPES([HERE(1:4) + H/2*K2, HERE(5) + H/2], PAR, K3)
     CALL SLOPES([HERE(1:4) + H*K3, HERE(5) + H], PAR, K4)
     HERE(1:4) = HERE(1:4) + H/6*(K1 + 2*K2 + 2*K3 + K4)
     HERE(5) = MERGE(R, HERE(5) + H, H == R - HERE(5))
  END DO
  U = HERE
END SUBROUTINE STPNT

SUBROUTINE BCND(NDIM, PAR, ICP, NBC, U0, U1, FB, IJAC, DBC)
  USE MEMBRANE
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM, ICP(*), NBC, IJAC
  DOUBLE PRECISION, INTENT(IN) :: PAR(*), U0(NDIM), U1(NDIM)
  DOUBLE PRECISION, INTENT(OUT) :: FB(NBC)
  DOUBLE PRECISION, INTENT(INOUT) :: DBC(NBC, *)
  DOUBLE PRECISION APEX_STATE(5)
  CALL SERIES(PAR, APEX_STATE)
  FB(1:5) = U0 - APEX_STATE
  FB(6) = U1(1) - PRESTRETCH
  IF (NBC == 7) FB(7) = PAR(PRESSURE) + ATMOSPHERE &
       - (PAR(FILLING_PRESSURE) + ATMOSPHERE)*(PAR(FILLING) + PAR(CHAMBER))/(U1(4) + PAR(CHAMBER))
END SUBROUTINE BCND

SUBROUTINE PVLS(NDIM, U, PAR)
  USE MEMBRANE
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM
  DOUBLE PRECISION, INTENT(IN) :: U(NDIM)
  DOUBLE PRECISION, INTENT(INOUT) :: PAR(*)
  DOUBLE PRECISION, EXTERNAL :: GETP
  DOUBLE PRECISION LA
  LA = PAR(APEX)
  PAR(VOLUME) = GETP('BV1', 4, U)
  ! E_EB = 30.6 lambda**1.13 MV/m, at most 218 MV/m
  PAR(BREAKDOWN) = PAR(LOAD)*LA**4*(FIELD/MIN(30.6D0*LA**1.13D0, 218D0))**2
END SUBROUTINE PVLS

SUBROUTINE ICND
END SUBROUTINE ICND

SUBROUTINE FOPT
END SUBROUTINE FOPT
